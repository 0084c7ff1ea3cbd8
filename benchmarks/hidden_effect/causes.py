"""What can be hidden in a case: mechanisms of the virtual mill, by the name that is right."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from dtwin.machines.mill import Disturbance, Moment
from dtwin.machines.mill_parameters import MillParameters

Change = Callable[[MillParameters, float], MillParameters]
Truths = Callable[[float], Mapping[str, float]]


@dataclass(frozen=True)
class Cause:
    """One thing that is wrong with the machine, with its size still open.

    ``also``: names beside its label that are right.
    """

    label: str
    start: float
    change: Change = lambda mill, size: mill
    disturbance: Callable[[float], Disturbance] | None = None
    truths: Truths = lambda size: {}
    design: str = "full"
    in_time: bool = False
    signed: bool = True
    also: tuple[str, ...] = ()


def _axis(label: str, axis: str, start: float, name: str, **options: object) -> Cause:
    """Return a cause that is one parameter of one axis."""

    def change(mill: MillParameters, size: float) -> MillParameters:
        return mill.with_axis(axis, **{name: getattr(mill.axis(axis), name) + size})

    return Cause(f"{label} {axis}", start, change, **options)  # type: ignore[arg-type]


def _lag(mill: MillParameters, axis: str, delay_ms: float) -> MillParameters:
    now = mill.axis(axis)
    less = delay_ms / 1000.0 * now.position_gain_1_s
    return mill.with_axis(axis, feed_forward=now.feed_forward - less)


def _named(effect: str, axis: str, parameter: str, factor: float = 1.0) -> Truths:
    return lambda size: {f"{effect}|{axis}|{parameter}": factor * size}


def backlash(axis: str, rng: np.random.Generator) -> Cause:
    return _axis("backlash", axis, 2.0, "play_um", signed=False, truths=_named("backlash", axis, "backlash"))


def backlash_taper(axis: str, rng: np.random.Generator) -> Cause:
    return _axis(
        "backlash_taper", axis, 2.0, "play_taper_um", truths=_named("backlash_taper", axis, "change_per_100_mm")
    )


def lateral_play(axis: str, rng: np.random.Generator) -> Cause:
    return _axis("lateral_play", axis, 2.0, "lateral_um", truths=_named("lateral_play", axis, "play"))


def lateral_play_taper(axis: str, rng: np.random.Generator) -> Cause:
    return _axis(
        "lateral_play_taper",
        axis,
        2.0,
        "lateral_taper_um",
        truths=_named("lateral_play_taper", axis, "change_per_100_mm"),
    )


def straightness(axis: str, rng: np.random.Generator) -> Cause:
    return _axis("straightness", axis, 2.0, "bow_um", truths=_named("straightness", axis, "bow_at_100_mm"))


def angular_error(axis: str, rng: np.random.Generator) -> Cause:
    return _axis(
        "angular_error",
        axis,
        10.0,
        "tilt_urad",
        design="heights",
        truths=_named("angular_error", axis, "tilt_over_100_mm"),
    )


def scale_mismatch(axis: str, rng: np.random.Generator) -> Cause:
    def change(mill: MillParameters, size: float) -> MillParameters:
        return mill.with_axis("X", scale_ppm=size / 2).with_axis("Y", scale_ppm=-size / 2)

    return Cause("scale_mismatch XY", 20.0, change, truths=_named("scale_mismatch", "XY", "scale"))


def squareness(axis: str, rng: np.random.Generator) -> Cause:
    def change(mill: MillParameters, size: float) -> MillParameters:
        return replace(mill, squareness_um_m={"XY": size})

    return Cause("squareness XY", 20.0, change, truths=_named("squareness", "XY", "squareness"))


def servo_mismatch(axis: str, rng: np.random.Generator) -> Cause:
    def change(mill: MillParameters, size: float) -> MillParameters:
        return _lag(_lag(mill, "X", size / 2), "Y", -size / 2)

    return Cause("servo_mismatch XY", 0.1, change, truths=_named("servo_mismatch", "XY", "delay"))


def servo_lag(axis: str, rng: np.random.Generator) -> Cause:
    def change(mill: MillParameters, size: float) -> MillParameters:
        return _lag(_lag(mill, "X", size), "Y", size)

    return Cause("servo_lag", 0.5, change, signed=False)


def cyclic_error(axis: str, rng: np.random.Generator) -> Cause:
    return _cyclic("cyclic_error", "pitch_error_um", axis, rng)


def cyclic_error_by_direction(axis: str, rng: np.random.Generator) -> Cause:
    return _cyclic("cyclic_error_by_direction", "pitch_flank_um", axis, rng)


def _cyclic(label: str, name: str, axis: str, rng: np.random.Generator) -> Cause:
    pitch, phase = float(np.exp(rng.uniform(np.log(2.0), np.log(40.0)))), rng.uniform(0, 6.28)

    def change(mill: MillParameters, size: float) -> MillParameters:
        return mill.with_axis(axis, pitch_mm=pitch, pitch_phase_rad=phase, **{name: size})

    return Cause(f"{label} {axis}", 1.0, change)


def reversal_spike(axis: str, rng: np.random.Generator) -> Cause:
    integral, travel = rng.uniform(10.0, 40.0), rng.uniform(0.002, 0.01)

    def change(mill: MillParameters, size: float) -> MillParameters:
        return mill.with_axis(axis, friction_mm_s2=20.0 * size, integral_time_ms=integral, presliding_mm=travel)

    return Cause(f"reversal_spike {axis}", 2.0, change, signed=False)


def friction(axis: str, rng: np.random.Generator) -> Cause:
    fading = rng.uniform(1.0, 5.0)

    def change(mill: MillParameters, size: float) -> MillParameters:
        return mill.with_axis(axis, stribeck_mm_s2=12.0 * size, stribeck_mm_s=fading, presliding_mm=0.005)

    return Cause(f"friction {axis}", 2.0, change, signed=False)


def reversal_ringing(axis: str, rng: np.random.Generator) -> Cause:
    hz, damping = rng.uniform(12.0, 30.0), rng.uniform(0.03, 0.1)

    def change(mill: MillParameters, size: float) -> MillParameters:
        return mill.with_axis(axis, mode_hz=hz, mode_damping=damping, breakaway_mm=1e-3 * size**2)

    return Cause(f"reversal_ringing {axis}", 1.0, change, signed=False)


def structural_resonance(axis: str, rng: np.random.Generator) -> Cause:
    hz, damping = rng.uniform(12.0, 30.0), rng.uniform(0.03, 0.1)

    def change(mill: MillParameters, size: float) -> MillParameters:
        return mill.with_axis(axis, mode_hz=hz, mode_damping=damping, mode_share=size, breakaway_mm=1e-3 * size**2)

    return Cause(f"structural_resonance {axis}", 0.3, change, signed=False)


def inertial_compliance(axis: str, rng: np.random.Generator) -> Cause:
    share = rng.uniform(-1.0, 1.0)

    def change(mill: MillParameters, size: float) -> MillParameters:
        for letter, part in (("X", 1.0), ("Y", share)):
            mill = mill.with_axis(letter, mode_hz=70.0, mode_share=size * part)
        return mill

    return Cause("inertial_compliance", 3.0, change, signed=False)


def measurement_delay(axis: str, rng: np.random.Generator) -> Cause:
    return Cause("measurement_delay", 5.0, lambda mill, size: replace(mill, delay_ms=size))


def axis_changeover(axis: str, rng: np.random.Generator) -> Cause:
    return Cause(
        "axis_changeover XY",
        1.0,
        lambda mill, size: replace(mill, changeover_um=size),
        truths=_named("axis_changeover", "XY", "step", -0.5),
    )


def instrument_artefact(axis: str, rng: np.random.Generator) -> Cause:
    phase = rng.uniform(0, 6.28)

    def change(mill: MillParameters, size: float) -> MillParameters:
        return replace(mill, cup_lobe_um=size, cup_phase_rad=phase)

    def truths(size: float) -> Mapping[str, float]:
        return {"instrument_artefact||cosine": size * np.cos(phase), "instrument_artefact||sine": -size * np.sin(phase)}

    return Cause("instrument_artefact", 1.0, change, truths=truths)


def thermal_growth(axis: str, rng: np.random.Generator) -> Cause:
    def change(mill: MillParameters, size: float) -> MillParameters:
        for letter in "XYZ":
            mill = mill.with_axis(letter, growth_um_m_k=size)
        return mill

    return Cause("thermal_growth", 10.0, change, in_time=True, signed=False)


def thermal_drift(axis: str, rng: np.random.Generator) -> Cause:
    a, b, c = rng.standard_normal(3)

    def change(mill: MillParameters, size: float) -> MillParameters:
        return replace(mill, shift_um_h=(a * size, b * size, 0.0), bar_growth_um_h=0.5 * c * size)

    return Cause("thermal_drift", 3.0, change, in_time=True)


LIBRARY = {
    make.__name__: make
    for make in (
        backlash,
        backlash_taper,
        lateral_play,
        lateral_play_taper,
        straightness,
        angular_error,
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
        measurement_delay,
        axis_changeover,
        instrument_artefact,
    )
}
# Effects whose sizes an ordinary mill has, and that the twin of a case already knows.
BASE = {
    "squareness:XY": (squareness, "XY", 25.0),
    "scale_mismatch:XY": (scale_mismatch, "XY", 25.0),
    "backlash:X": (backlash, "X", 3.0),
    "backlash:Y": (backlash, "Y", 3.0),
    "straightness:X": (straightness, "X", 2.0),
    "straightness:Y": (straightness, "Y", 2.0),
    "servo_mismatch:XY": (servo_mismatch, "XY", 0.1),
}


def _law(shape: Callable[[Moment], np.ndarray]) -> Callable[[float], Disturbance]:
    return lambda size: lambda moment: size * shape(moment)


def _feed(moment: Moment) -> float:
    return moment.test.feed_mm_min / 2000.0


def _odd(moment: Moment) -> float:
    return 1.0 if moment.test.direction == "CCW" else -1.0


def foreign(kind: str, rng: np.random.Generator) -> Cause:
    """Return a cause that no effect of the library describes."""
    phase = rng.uniform(0, 6.28)
    axis = "XY"[rng.integers(2)]
    shapes: dict[str, Callable[[Moment], np.ndarray]] = {
        "threshold_lobe": lambda m: (_feed(m) > 1.5) * np.cos(5 * m.angle_rad + phase),
        "gear_harmonic": lambda m: np.cos(7 * m.angle_rad + phase),
        "lobe_with_feed": lambda m: _odd(m) * _feed(m) * np.sin(3 * m.angle_rad),
        "heat_times_feed": lambda m: m.rise_c * _feed(m) * np.cos(2 * m.angle_rad + phase),
        "square_law": lambda m: _odd(m) * _feed(m) ** 2 * np.sin(2 * m.angle_rad),
        "flat_law": lambda m: _odd(m) * np.sin(2 * m.angle_rad),
    }
    if kind in shapes:
        return Cause(kind, 1.0, disturbance=_law(shapes[kind]), in_time=kind == "heat_times_feed")
    if kind == "quartic_scale":
        # An axis that is off by a cube of its place has a smooth pitch error, and a scale that is off.
        also = (f"pitch_error {axis}", "scale_mismatch XY")
        return replace(_axis("", axis, 1.0, "scale_cubic_um"), label=kind, also=also)
    if kind == "play_curve":
        return replace(_axis("", axis, 1.0, "play_curve_um"), label=kind)
    if kind == "hysteretic_heat":

        def change(mill: MillParameters, size: float) -> MillParameters:
            slow = replace(mill.heat, lag_share=1.0)
            return replace(mill.with_axis(axis, growth_um_m_k=size), heat=slow)

        return Cause(f"{kind} {axis}", 10.0, change, in_time=True)
    raise KeyError(kind)
