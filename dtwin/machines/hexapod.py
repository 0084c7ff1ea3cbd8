"""The virtual hexapod cell: a floor hexapod carries a ball round a ball on the wall hexapod.

The control turns the path into six leg lengths by the inverse kinematics that it believes in;
the legs follow with what their screws and loops do; where the platform really is comes from the
forward kinematics of the true joints. The wall hexapod stands still and only holds its ball.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np

from dtwin.errors import InputError
from dtwin.kinematics import kernel, plane_axes
from dtwin.machines._joints import mode_table, modes_kernel, play_kernel
from dtwin.machines._sensors import read_ballbar
from dtwin.machines.hexapod_parameters import CENTRE_MM, LEGS, HexapodParameters, build_legs
from dtwin.machines.motion import CircleCondition, travelled_kernel
from dtwin.schema import Floats, SignalGroup
from dtwin.units import G_MM_S2, UM_PER_MM

_RATE_HZ = 2048.0
"""Rate of the simulation and of the accelerometer."""
_OVERSHOOT_DEG, _TURN_DEG = 180.0, 360.0
_REST_S = 0.25
_ROUNDS = 8
# Constants of the legs, as the kernel takes them.
_GAIN, _PLAY, _FRICTION, _WIDTH, _RECOVERY, _PITCH, _ORDER, _SHAKE = range(8)
_RADII_MM, _FEEDS_MM_MIN = (10.0, 100.0), (50.0, 12_000.0)


@dataclass(frozen=True)
class _HexapodRecording:
    """What the instruments recorded, and what happened.

    ``condition``: in standard form.
    ``t_s``, ``deviation_um``, (n,): ball bar: time by its clock, length minus nominal radius.
    ``angle_deg``, (n,): commanded path angle of each reading; 0 where the turn begins.
    ``window``: first and one-past-last reading of the turn between the overshoots.
    ``tool_mm``, (ticks, 3): where the ball in the spindle really was, at ``_RATE_HZ``.
    """

    condition: CircleCondition
    t_s: Floats
    deviation_um: Floats
    angle_deg: Floats
    window: tuple[int, int]
    vibration: SignalGroup
    tool_mm: Floats


class VirtualHexapod:
    """A hexapod cell with ball bar and accelerometer, whose errors are known.

    The seed says which of the machines that share these parameters it is, and is of its mountings and its noise.
    """

    def __init__(self, parameters: HexapodParameters | None = None, seed: int = 0) -> None:
        self.parameters = parameters or HexapodParameters()
        self.seed = seed
        self.legs = build_legs(self.parameters, np.random.default_rng([seed, 1]))

    def measure(self, condition: CircleCondition, *, setup: str, repeat: int) -> _HexapodRecording:
        """Return the recording of one run with half a turn before and after.

        Set-up and errors as for :meth:`dtwin.machines.cobot.VirtualCobot.measure`.
        """
        condition = condition.standard()
        _require_reach(condition)
        angle = _path_angle_rad(condition, self.parameters)
        tool = self.tool_mm(condition, angle)
        key = zlib.crc32(repr((condition, setup)).encode())
        rng = np.random.default_rng([self.seed, 3, key, repeat])
        mounting = np.random.default_rng([self.seed, 2, zlib.crc32(setup.encode())])
        p = self.parameters
        ball = mounting.standard_normal(3) * p.eccentricity_um / UM_PER_MM
        longer = float(mounting.standard_normal() * p.length_error_um)
        n = int(len(angle) / _RATE_HZ * p.bar.rate_hz)
        noise = longer + p.bar.noise_um * rng.standard_normal(n)
        # Zeroed where the tool ball is when the control believes it in the centre.
        centre = self.centre_mm() + ball
        clock = (0.0, 0.0, n)
        bar = read_ballbar(p.bar, tool, _RATE_HZ, centre, condition.radius_mm, clock, noise)
        t_s = np.arange(n) / p.bar.rate_hz
        degrees = np.degrees(np.interp(t_s, np.arange(len(angle)) / _RATE_HZ, angle))
        inside = np.flatnonzero((degrees * condition.sign >= 0.0) & (np.abs(degrees) < _TURN_DEG))
        return _HexapodRecording(
            condition,
            t_s,
            UM_PER_MM * bar,
            degrees,
            (int(inside[0]), int(inside[-1]) + 1),
            _felt(tool, p.accelerometer_noise_g, rng),
            tool,
        )

    def tool_mm(self, condition: CircleCondition, angle_rad: Floats) -> Floats:
        """Return where the ball in the spindle really is, shape (n, 3).

        ``condition``: in standard form.
        ``angle_rad`` (n,): commanded path angle at ``_RATE_HZ``.
        """
        first, second = plane_axes(condition.plane)
        spoke = np.cos(angle_rad)[:, None] * first + np.sin(angle_rad)[:, None] * second
        return self._run(CENTRE_MM + condition.radius_mm * spoke)

    def centre_mm(self) -> Floats:
        """Return where the ball really is when it rests in the believed centre."""
        return np.asarray(self._run(np.tile(CENTRE_MM, (8, 1)))[-1])

    def _run(self, path_mm: Floats) -> Floats:
        p = self.parameters
        constants = np.array(
            [
                p.position_gain_1_s,
                p.play_um / UM_PER_MM,
                p.friction_um / UM_PER_MM,
                p.friction_width_um / UM_PER_MM,
                p.friction_recovery_s,
                p.pitch_mm,
                p.motor_order,
                p.vibration_um_s_mm / UM_PER_MM,
            ]
        )
        legs = self.legs
        out = np.empty_like(path_mm)
        _follow_kernel(
            path_mm,
            legs.believed,
            legs.true,
            np.stack([legs.offset_mm, legs.scale_1, legs.feed_forward]),
            constants,
            mode_table(p.structure),
            self._inverse(),
            p.tool_mm,
            out,
        )
        return out

    def _inverse(self) -> Floats:
        rows = np.empty((LEGS, 6))
        platform = CENTRE_MM - np.array([0.0, 0.0, self.parameters.tool_mm])
        _leg_lengths_kernel(platform, np.zeros(3), self.legs.true, np.empty(LEGS), rows)
        return np.asarray(np.linalg.inv(rows), dtype=np.float64)


def _path_angle_rad(condition: CircleCondition, parameters: HexapodParameters) -> Floats:
    """Return the commanded path angle at ``_RATE_HZ``: 0 where the turn begins, signed by direction.

    ``condition``: in standard form.
    ``parameters``: gives the limits along the path.
    """
    p = parameters
    jerk_s = p.acceleration_mm_s2 / p.jerk_mm_s3
    speed = condition.feed_mm_min / 60.0
    ramp_s = speed / p.acceleration_mm_s2
    length_mm = np.radians(_TURN_DEG + 2.0 * _OVERSHOOT_DEG) * condition.radius_mm
    moving_s = length_mm / speed + ramp_s + jerk_s
    ticks = np.arange(round((moving_s + 2.0 * _REST_S) * _RATE_HZ)) / _RATE_HZ - _REST_S
    way_mm = np.array([travelled_kernel(min(max(t, 0.0), moving_s), moving_s, speed, ramp_s, jerk_s) for t in ticks])
    return condition.sign * (way_mm / condition.radius_mm - np.radians(_OVERSHOOT_DEG))


def _felt(tool_mm: Floats, noise_g: float, rng: np.random.Generator) -> SignalGroup:
    bend = np.zeros_like(tool_mm)
    bend[1:-1] = (tool_mm[2:] - 2.0 * tool_mm[1:-1] + tool_mm[:-2]) * _RATE_HZ**2 / G_MM_S2
    bend += noise_g * rng.standard_normal(bend.shape)
    columns = {f"spindle_{axis}_g": bend[:, i].astype(np.float32) for i, axis in enumerate("xyz")}
    return SignalGroup("accelerometer", _RATE_HZ, columns)


def _require_reach(condition: CircleCondition) -> None:
    radius, feed = condition.radius_mm, condition.feed_mm_min
    if not (_RADII_MM[0] <= radius <= _RADII_MM[1] and _FEEDS_MM_MIN[0] <= feed <= _FEEDS_MM_MIN[1]):
        raise InputError(
            "radius or feed is outside what this hexapod can do",
            code="run.condition",
            got=f"radius {radius:g} mm, feed {feed:g} mm/min",
            allowed=f"radius {_RADII_MM[0]:g} to {_RADII_MM[1]:g} mm, feed {_FEEDS_MM_MIN[0]:g} to "
            f"{_FEEDS_MM_MIN[1]:g} mm/min",
        )


@kernel
def _cross(a: Floats, b: Floats, i: int) -> float:
    j, k = (i + 1) % 3, (i + 2) % 3
    return float(a[j] * b[k] - a[k] * b[j])


@kernel
def _leg_lengths_kernel(
    position_mm: Floats, turned_rad: Floats, joints: Floats, length_mm: Floats, rows: Floats
) -> None:
    """Write the leg lengths of a pose, and by what each changes with the pose.

    ``position_mm``, ``turned_rad``, (3,): centre of the platform; small rotation vector, to first order.
    ``joints``, (2, 6, 3): joint centres on base and platform.
    ``length_mm``, (6,): receives the lengths.
    ``rows``, (6, 6): receives the derivative by position and rotation.
    """
    along = np.empty(3)
    for leg in range(LEGS):
        arm = joints[1, leg]
        square = 0.0
        for i in range(3):
            turned = _cross(turned_rad, arm, i)
            along[i] = position_mm[i] + arm[i] + turned - joints[0, leg, i]
            square += along[i] * along[i]
        length_mm[leg] = np.sqrt(square)
        for i in range(3):
            along[i] /= length_mm[leg]
            rows[leg, i] = along[i]
        for i in range(3):
            rows[leg, 3 + i] = _cross(arm, along, i)


@kernel
def _follow_kernel(
    path_mm: Floats,
    believed: Floats,
    true: Floats,
    legs: Floats,
    constants: Floats,
    modes: Floats,
    inverse: Floats,
    tool_mm: float,
    out_mm: Floats,
) -> None:
    """Follow a commanded path of the tool ball, tick by tick, and write where it really is.

    ``path_mm``, (n, 3): command.
    ``believed``, ``true``, (2, 6, 3): joint centres.
    ``legs``, (3, 6): zero in mm, relative scale error, feed-forward.
    ``constants``, (8,): gain, play, friction (height, width, recovery), pitch, motor order, vibration.
    ``modes``, (m, 10): from ``mode_table``.
    ``inverse``, (6, 6): how the pose changes with the leg lengths in the centre; near it every round of the forward
    kinematics leaves less than a sixth of the error.
    ``tool_mm``: length of the tool along the platform's normal.
    ``out_mm``, (n, 3): receives the positions.
    """
    tick_s = 1.0 / _RATE_HZ
    tool = np.array([0.0, 0.0, tool_mm])
    wanted, before, actual = np.empty(LEGS), np.empty(LEGS), np.empty(LEGS)
    behind, press, relaxed = np.empty(LEGS), np.zeros(LEGS), np.zeros(LEGS)
    reached, length, rows = np.empty(LEGS), np.empty(LEGS), np.empty((LEGS, 6))
    pose, flat = np.zeros(6), np.zeros(3)
    pose[:3] = path_mm[0] - tool
    rigid, bend, first, second = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    state, jolt, flange = np.zeros(2 * modes.shape[0]), np.zeros(3), np.zeros(3)
    for n in range(path_mm.shape[0]):
        _leg_lengths_kernel(path_mm[n] - tool, flat, believed, wanted, rows)
        if n == 0:
            before[:], actual[:], behind[:] = wanted, wanted, wanted
        for leg in range(LEGS):
            speed = (wanted[leg] - before[leg]) / tick_s
            error = before[leg] - actual[leg]
            moved = tick_s * (constants[_GAIN] * error + legs[2, leg] * speed)
            actual[leg] += moved
            pressed = press[leg] + 2.0 * moved / constants[_WIDTH]
            press[leg] = min(max(pressed, -1.0), 1.0)
            relaxed[leg] += (press[leg] - relaxed[leg]) * tick_s / constants[_RECOVERY]
            nut = actual[leg] - constants[_FRICTION] * (press[leg] - relaxed[leg])
            behind[leg] = play_kernel(nut, behind[leg], constants[_PLAY])
            turn = 2.0 * np.pi * constants[_ORDER] * actual[leg] / constants[_PITCH]
            shake = constants[_SHAKE] * abs(moved / tick_s) * np.sin(turn)
            reached[leg] = behind[leg] * (1.0 + legs[1, leg]) + legs[0, leg] + shake
            before[leg] = wanted[leg]
        for _ in range(_ROUNDS):
            _leg_lengths_kernel(pose[:3], pose[3:], true, length, rows)
            for i in range(6):
                for leg in range(LEGS):
                    pose[i] += inverse[i, leg] * (reached[leg] - length[leg])
        for i in range(3):
            rigid[i] = pose[i] + tool[i] + _cross(pose[3:], tool, i)
            if n == 0:
                first[i], second[i] = rigid[i], rigid[i]
            bend[i] = (rigid[i] - 2.0 * first[i] + second[i]) / tick_s**2
            second[i], first[i] = first[i], rigid[i]
        modes_kernel(modes, tick_s, 0.0, 1.0, bend, jolt, state, rigid, flange)
        for i in range(3):
            out_mm[n, i] = rigid[i]
