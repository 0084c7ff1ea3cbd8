"""What can be wrong with the second machine, by the name that the library has for it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from second_machine import HALF_TRAVEL_MM, Fault, Machine

_ENTRIES = 32  # of a lead table, in a turn


def _alone(label: str, axis: str, **sizes: float) -> Fault:
    """Return a fault that adds its size in µm, times a factor, to numbers of an axis in mm."""

    def change(machine: Machine, size: float) -> Machine:
        now = machine.axis(axis)
        added = {name: getattr(now, name) + 1e-3 * size * f for name, f in sizes.items()}
        return machine.with_axis(axis, **added)

    return Fault(f"{label} {axis}", change)


def backlash(axis: str, rng: np.random.Generator) -> Fault:
    return replace(_alone("backlash", axis, play=1.0), signed=False)


def backlash_taper(axis: str, rng: np.random.Generator) -> Fault:
    return _alone("backlash_taper", axis, play_slope=0.01)


def lateral_play(axis: str, rng: np.random.Generator) -> Fault:
    return _alone("lateral_play", axis, aside=1.0)


def lateral_play_taper(axis: str, rng: np.random.Generator) -> Fault:
    return _alone("lateral_play_taper", axis, aside_slope=0.01)


def straightness(axis: str, rng: np.random.Generator) -> Fault:
    bent, cubic = _alone("straightness", axis, bow=1.0), rng.uniform(-0.05, 0.05)

    def change(machine: Machine, size: float) -> Machine:
        return bent.change(machine, size).with_axis(axis, bow_cubic=cubic)

    return replace(bent, change=change, also=(f"guideway_shape {axis}",))


def scale_mismatch(axis: str, rng: np.random.Generator) -> Fault:
    def change(machine: Machine, size: float) -> Machine:
        return machine.with_axis("X", scale=0.5e-5 * size).with_axis("Y", scale=-0.5e-5 * size)

    return Fault("scale_mismatch XY", change)


def squareness(axis: str, rng: np.random.Generator) -> Fault:
    return Fault("squareness XY", lambda machine, size: replace(machine, lean=1e-5 * size))


def _smoothed(machine: Machine, more_s: tuple[float, float]) -> Machine:
    for axis, more in zip("XY", more_s, strict=True):
        machine = machine.with_axis(axis, smoothing_s=machine.axis(axis).smoothing_s + more)
    return machine


def servo_mismatch(axis: str, rng: np.random.Generator) -> Fault:
    # Half a millisecond is there to take from: ten times what is needed.
    return Fault("servo_mismatch XY", lambda m, ms: _smoothed(m, (5e-4 * ms, -5e-4 * ms)), start=0.1)


def servo_lag(axis: str, rng: np.random.Generator) -> Fault:
    return Fault("servo_lag", lambda m, ms: _smoothed(m, (1e-3 * ms, 1e-3 * ms)), False, 8.0)


def _screw(label: str, name: str, axis: str, rng: np.random.Generator) -> Fault:
    """Return a screw whose thread was measured: two waves a turn, some more here than there, and rough."""
    pitch = float(rng.choice((4.0, 5.0, 6.0, 8.0, 10.0, 12.0, 16.0, 20.0, 25.0)))
    entry = pitch / _ENTRIES
    at = entry * np.arange(int(2.0 * HALF_TRAVEL_MM / entry) + 2)
    turn = 2.0 * np.pi * (at / pitch + rng.random())
    uneven = np.interp(at, np.linspace(0.0, at[-1], 6), rng.uniform(0.95, 1.05, 6))
    table = uneven * (np.cos(turn) + 0.15 * np.cos(2.0 * turn + rng.uniform(0.0, 6.28)))
    table += 0.1 * rng.standard_normal(at.size)

    def change(machine: Machine, size: float) -> Machine:
        tables = [table if c == axis else t for c, t in zip("XY", machine.tables, strict=True)]
        machine = replace(machine, tables=(tables[0], tables[1]))
        return machine.with_axis(axis, entry_mm=entry, **{name: 1e-3 * size})

    return Fault(f"{label} {axis}", change)


def cyclic_error(axis: str, rng: np.random.Generator) -> Fault:
    return _screw("cyclic_error", "lead", axis, rng)


def cyclic_error_by_direction(axis: str, rng: np.random.Generator) -> Fault:
    return _screw("cyclic_error_by_direction", "flank", axis, rng)


def _rubbing(label: str, axis: str, integral_s: float, static: float, fading_mm_s: float, slip_mm: float) -> Fault:
    def change(machine: Machine, size: float) -> Machine:
        return machine.with_axis(
            axis,
            integral_s=integral_s,
            friction=10.0 * size,
            static_share=static,
            fading_mm_s=fading_mm_s,
            slip_mm=slip_mm,
        )

    return Fault(f"{label} {axis}", change, signed=False)


def reversal_spike(axis: str, rng: np.random.Generator) -> Fault:
    integral, slip = rng.uniform(0.01, 0.04), rng.uniform(0.002, 0.01)
    return _rubbing("reversal_spike", axis, integral, 0.1, 1.0, slip)


def friction(axis: str, rng: np.random.Generator) -> Fault:
    return _rubbing("friction", axis, 0.0, rng.uniform(0.5, 2.0), rng.uniform(2.0, 6.0), rng.uniform(0.04, 0.2))


def _mode(label: str, axis: str, swing: float, rng: np.random.Generator) -> Fault:
    hz, damping, gap = rng.uniform(12.0, 30.0), rng.uniform(0.03, 0.1), rng.uniform(2e-4, 5e-4)

    def change(machine: Machine, size: float) -> Machine:
        return machine.with_axis(axis, mode_hz=hz, damping=damping, gap=gap, knock=size, swing=0.2 * size * swing)

    return Fault(f"{label} {axis}", change, signed=False)


def reversal_ringing(axis: str, rng: np.random.Generator) -> Fault:
    return _mode("reversal_ringing", axis, 0.0, rng)


def structural_resonance(axis: str, rng: np.random.Generator) -> Fault:
    return _mode("structural_resonance", axis, 1.0, rng)


def inertial_compliance(axis: str, rng: np.random.Generator) -> Fault:
    # Were both axes as soft, one circle would show a longer bar and nothing else.
    hz, other = rng.uniform(60.0, 90.0), rng.uniform(0.0, 0.5)

    def change(machine: Machine, size: float) -> Machine:
        machine = machine.with_axis("X", mode_hz=hz, swing=size)
        return machine.with_axis("Y", mode_hz=hz, swing=size * other)

    return Fault("inertial_compliance", change, signed=False)


LIBRARY = {
    make.__name__: make
    for make in (
        backlash,
        backlash_taper,
        lateral_play,
        lateral_play_taper,
        straightness,
        scale_mismatch,
        squareness,
        servo_mismatch,
        servo_lag,
        cyclic_error,
        cyclic_error_by_direction,
        reversal_spike,
        friction,
        reversal_ringing,
        structural_resonance,
        inertial_compliance,
    )
}
