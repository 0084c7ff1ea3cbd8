"""What the virtual hexapod cell is like: its size, and what its legs and structure do wrong.

The published cell holds two commercial hexapods; their dimensions and drives are not printed. The
numbers here are plausible ones for parallel kinematics of that size and belong to no real machine.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from dtwin.machines.parameters import BallbarParameters, StructureParameters
from dtwin.schema import Floats

LEGS = 6
CENTRE_MM = np.array([0.0, 0.0, 870.0])
"""Centre of the published circles in the frame of the floor hexapod's base."""


def _modes() -> StructureParameters:
    return StructureParameters(
        frequency_hz=(24.0, 29.0, 41.0),
        damping_ratio=(0.03, 0.03, 0.04),
        shape=((0.0, 1.0, 0.15), (1.0, 0.0, 0.0), (0.0, -0.1, 1.0)),
        participation=(1.0, 1.0, 1.0),
        jolt_participation=(0.0, 0.0, 0.0),
        flange_share=(1.0, 1.0, 1.0),
        base_share=0.0,
        jolt_speed_share=0.0,
        restart_share=0.0,
        jolt_s=0.02,
    )


@dataclass(frozen=True)
class HexapodParameters:
    """A floor hexapod that carries the spindle, and the instruments on it.

    ``base_radius_mm``, ``platform_radius_mm``: circles on which the joints sit.
    ``base_half_deg``, ``platform_half_deg``: half the angle between the two joints of a pair.
    ``tool_mm``: from the platform's centre up to the ball in the spindle.
    ``joint_centre_mm``, ``leg_offset_mm``, ``leg_scale_ppm``: standard deviations of what the control believes wrongly.
    ``play_um``, ``friction_um``: lost motion of a leg; how far friction holds it back after a reversal.
    ``friction_width_um``, ``friction_recovery_s``: way over which friction builds up, and time in which the loop works
    it off.
    ``position_gain_1_s``, ``feed_forward``, ``feed_forward_spread``: position loop of a leg; the spread differs from
    leg to leg.
    ``pitch_mm``, ``motor_order``: way of a leg per turn of its screw; vibrations per turn.
    ``vibration_um_s_mm``: amplitude of motor vibration for each mm/s of the leg.
    ``eccentricity_um``, ``length_error_um``: standard deviations of a mounting of the bar.
    """

    base_radius_mm: float = 480.0
    platform_radius_mm: float = 240.0
    base_half_deg: float = 12.0
    platform_half_deg: float = 10.0
    tool_mm: float = 190.0
    joint_centre_mm: float = 0.3
    leg_offset_mm: float = 0.05
    leg_scale_ppm: float = 300.0
    play_um: float = 5.0
    friction_um: float = 4.0
    friction_width_um: float = 20.0
    friction_recovery_s: float = 0.08
    position_gain_1_s: float = 40.0
    feed_forward: float = 0.99
    feed_forward_spread: float = 0.003
    pitch_mm: float = 10.0
    motor_order: float = 9.0
    vibration_um_s_mm: float = 0.03
    structure: StructureParameters = field(default_factory=_modes)
    acceleration_mm_s2: float = 400.0
    jerk_mm_s3: float = 4000.0
    eccentricity_um: float = 6.0
    length_error_um: float = 1.0
    bar: BallbarParameters = field(
        default_factory=lambda: BallbarParameters(
            rate_hz=1000.0, quantum_um=0.1, noise_um=0.15, clock_offset_s=0.0, clock_error_ppm=0.0, trigger_mm=0.0
        )
    )
    accelerometer_noise_g: float = 2e-4

    def without_dynamics(self) -> HexapodParameters:
        """Return the same machine with stiff structure, perfect loops and quiet motors."""
        still = replace(self.structure, participation=(0.0,) * len(self.structure.frequency_hz))
        return replace(
            self, structure=still, vibration_um_s_mm=0.0, feed_forward=1.0, friction_um=0.0, feed_forward_spread=0.0
        )


@dataclass(frozen=True)
class _Legs:
    """Geometry of one machine, as the control believes it and as it is.

    ``believed``, ``true``, (2, 6, 3): joint centres on the base, in its frame, and on the platform, in its own, mm.
    ``offset_mm``, ``scale_1``, ``feed_forward``, (6,): zero of each leg, relative error of its scale, feed-forward of
    its loop.
    """

    believed: Floats
    true: Floats
    offset_mm: Floats
    scale_1: Floats
    feed_forward: Floats


def build_legs(parameters: HexapodParameters, rng: np.random.Generator) -> _Legs:
    """Draw one machine. ``rng``: which of the machines that share these parameters."""
    p = parameters
    base = _ring(p.base_radius_mm, p.base_half_deg, turned_deg=0.0)
    platform = _ring(p.platform_radius_mm, p.platform_half_deg, turned_deg=60.0)
    # Leg i runs from its base joint to the nearer platform joint of the next pair.
    believed = np.stack([base, np.roll(platform, 1, axis=0)])
    return _Legs(
        believed,
        believed + p.joint_centre_mm * rng.standard_normal(believed.shape),
        p.leg_offset_mm * rng.standard_normal(LEGS),
        1e-6 * p.leg_scale_ppm * rng.standard_normal(LEGS),
        p.feed_forward + p.feed_forward_spread * rng.standard_normal(LEGS),
    )


def _ring(radius_mm: float, half_deg: float, *, turned_deg: float) -> Floats:
    middles = np.repeat([0.0, 120.0, 240.0], 2) + turned_deg
    angle = np.radians(middles + np.tile([-half_deg, half_deg], 3))
    return radius_mm * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(LEGS)])
