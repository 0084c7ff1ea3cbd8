"""What can be wrong with the outside machine: its law, the names that are right, and how it is drawn.

A fault changes the drive of an axis, or pushes the tool aside by where the axes are and how they move.
Sizes are drawn so that most show with 1.5 to 14 µm peak to peak; nothing is simulated for that.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from drives import STEP_S, Axis
from numba import njit

from dtwin.schema import Floats, Plane

PLANES: Mapping[Plane, tuple[str, str]] = {"XY": ("X", "Y"), "YZ": ("Y", "Z"), "ZX": ("Z", "X")}
_LEAST_UM, _MOST_UM = 1.5, 14.0
# A nut with play needs a guideway that holds the table.
_HOLDING_N = 45.0


@dataclass(frozen=True)
class Motion:
    """How the machine moved on a circle.

    Attributes:
        place_mm, speed_mm_s: Of each axis that moved; places about the middle of the circle. Shape (n,) each.
        minute: Since the session began. Shape (n,).
    """

    place_mm: Mapping[str, Floats]
    speed_mm_s: Mapping[str, Floats]
    minute: Floats
    radius_mm: float


@dataclass(frozen=True)
class Design:
    """Which circles are measured; each plane and radius is one set-up of the bar."""

    planes: tuple[Plane, ...]
    radii_mm: tuple[float, ...]
    feeds_mm_min: tuple[float, ...]
    repeats: int

    @property
    def axes(self) -> list[str]:
        """Letters of the axes that move."""
        return sorted({letter for plane in self.planes for letter in PLANES[plane]})


def _drive_as_it_is(axis: Axis, minute: float) -> Axis:
    return axis


def _pushes_nothing(motion: Motion) -> dict[str, Floats]:
    return {}


@dataclass(frozen=True)
class Fault:
    """One thing that is wrong.

    Attributes:
        axis: Letter of the axis, a plane, or empty for all axes.
        names, consequences: Labels of dtwin that name it, and those that are true of the machine because of it.
        drive: Returns the drive at the start of a run, from the drive without the fault and the minute.
        push: Returns what is added along axes, µm, shape (n,).
    """

    kind: str
    axis: str
    names: frozenset[str] = frozenset()
    consequences: frozenset[str] = frozenset()
    drive: Callable[[Axis, float], Axis] = field(default=_drive_as_it_is, repr=False)
    push: Callable[[Motion], dict[str, Floats]] = field(default=_pushes_nothing, repr=False)

    def __str__(self) -> str:
        return f"{self.kind} {self.axis}".rstrip()


def _labels(axis: str, *effects: str) -> frozenset[str]:
    return frozenset(f"{effect} {axis}" for effect in effects)


def _also_by_plane(axis: str, *effects: str) -> frozenset[str]:
    """Return labels of effects that are told by axis, by plane, or for the whole machine."""
    where = [axis, *(plane for plane in PLANES if axis in plane)]
    return frozenset(effects) | {f"{effect} {letters}" for effect in effects for letters in where}


def backlash(axis: str, wanted_um: float, centre_mm: float, rng: np.random.Generator) -> Fault:
    worn, worn_at = float(rng.choice([0.0, 0.0, 0.4])), 1e-3 * (centre_mm + rng.uniform(-40.0, 40.0))

    def drive(a: Axis, minute: float) -> Axis:
        return a._replace(play_m=1e-6 * wanted_um, worn=worn, worn_at_m=worn_at, table_n=max(a.table_n, _HOLDING_N))

    names = _labels(axis, "backlash", "backlash_taper")
    return Fault("backlash", axis, names, _labels(axis, "friction", "reversal_spike", "stick_slip"), drive)


def friction(axis: str, wanted_um: float, rng: np.random.Generator) -> Fault:
    at_table = bool(rng.choice([False, True]))
    static, fading, preslide = rng.uniform(0.1, 0.7), rng.uniform(0.001, 0.006), rng.uniform(2e-6, 8e-6)

    def drive(a: Axis, minute: float) -> Axis:
        a = a._replace(static_share=static, fading_m_s=fading, preslide_m=preslide)
        if at_table:
            return a._replace(table_n=a.table_n + 25.0 * wanted_um)
        return a._replace(screw_n=a.screw_n + 60.0 * wanted_um)

    names = _labels(axis, "friction", "reversal_spike", "stick_slip")
    return Fault("friction", axis, names, _labels(axis, "backlash"), drive)


def cyclic(axis: str, wanted_um: float, rng: np.random.Generator) -> Fault:
    pitch, phase, second = (
        1e-3 * float(rng.choice([8.0, 10.0, 12.0, 16.0, 20.0])),
        rng.uniform(0.0, 6.28),
        rng.uniform(0.0, 0.3),
    )

    def drive(a: Axis, minute: float) -> Axis:
        return a._replace(wave_m=1e-6 * wanted_um / 2.2, pitch_m=pitch, wave_phase=phase, wave_second=second)

    return Fault("cyclic", axis, _labels(axis, "cyclic_error", "cyclic_error_by_direction"), drive=drive)


def scale(axis: str, signed_um: float, radius_mm: float) -> Fault:
    def drive(a: Axis, minute: float) -> Axis:
        return a._replace(scale=a.scale + 1e-3 * signed_um / radius_mm)

    return Fault("scale", axis, _also_by_plane(axis, "scale_mismatch"), drive=drive)


def kv_mismatch(axis: str, signed_um: float, feed_mm_min: float) -> Fault:
    less = signed_um / (0.3 * feed_mm_min)

    def drive(a: Axis, minute: float) -> Axis:
        return a._replace(loop_1_s=a.loop_1_s * (1.0 - less), speed_forward=a.speed_forward - less)

    return Fault("kv_mismatch", axis, _also_by_plane(axis, "servo_mismatch"), drive=drive)


def servo_lag(rng: np.random.Generator) -> Fault:
    less = rng.uniform(0.06, 0.4)

    def drive(a: Axis, minute: float) -> Axis:
        return a._replace(speed_forward=a.speed_forward - less, acceleration_forward=0.0)

    return Fault("servo_lag", "", frozenset(["servo_lag"]), drive=drive)


def mode(axis: str, wanted_um: float, fastest_mm_s2: float, rng: np.random.Generator) -> Fault:
    omega, damping = 2.0 * math.pi * rng.uniform(14.0, 45.0), rng.uniform(0.02, 0.08)
    share = 1e-3 * wanted_um * omega**2 / fastest_mm_s2

    def drive(a: Axis, minute: float) -> Axis:
        return a._replace(mode_rad_s=omega, mode_damping=damping, mode_share=share)

    names = _labels(axis, "structural_resonance", "reversal_ringing") | _also_by_plane(axis, "inertial_compliance")
    return Fault("mode", axis, names, frozenset(["servo_lag"]), drive)


def heat(axis: str, rng: np.random.Generator) -> Fault:
    ppm, fading_min = _sign(rng) * rng.uniform(25.0, 60.0), rng.uniform(15.0, 45.0)

    def drive(a: Axis, minute: float) -> Axis:
        return a._replace(scale=a.scale + 1e-6 * ppm * (1.0 - math.exp(-minute / fading_min)))

    also = _also_by_plane(axis, "scale_mismatch", "thermal_drift")
    return Fault("heat", axis, _also_by_plane(axis, "thermal_growth", "warming_growth"), also, drive)


def drift(axis: str, rng: np.random.Generator) -> Fault:
    um, fading_min = _sign(rng) * rng.uniform(5.0, 12.0), rng.uniform(15.0, 45.0)

    def push(motion: Motion) -> dict[str, Floats]:
        return {axis: um * (1.0 - np.exp(-motion.minute / fading_min))} if axis in motion.place_mm else {}

    return Fault("drift", axis, _also_by_plane(axis, "thermal_drift"), push=push)


def squareness(plane: Plane, signed_um: float, radius_mm: float) -> Fault:
    first, second = PLANES[plane]

    def push(motion: Motion) -> dict[str, Floats]:
        place = motion.place_mm
        return {first: -signed_um / radius_mm * place[second]} if first in place and second in place else {}

    return Fault("squareness", plane, _labels(plane, "squareness"), push=push)


def straightness(axis: str, toward: str, signed_um: float, span_mm: float, rng: np.random.Generator) -> Fault:
    kind, shift, skew = str(rng.choice(list(GUIDEWAYS))), rng.uniform(-0.4, 0.4), rng.uniform(-1.0, 1.0)
    shape = GUIDEWAYS[kind]
    whole = np.linspace(-1.0, 1.0, 401)
    line = np.polyfit(whole, shape(whole, shift, skew), 1)
    most = float(np.ptp(shape(whole, shift, skew) - np.polyval(line, whole)))

    def push(motion: Motion) -> dict[str, Floats]:
        if not {axis, toward} <= set(motion.place_mm):
            return {}
        at = motion.place_mm[axis] / span_mm
        # Only some three quarters of the shape are seen beside centre and radius.
        return {toward: signed_um / 0.75 * (shape(at, shift, skew) - np.polyval(line, at)) / most}

    tilts = frozenset(f"squareness {plane}" for plane in PLANES if {axis, toward} == set(plane))
    return Fault("straightness", axis, _labels(axis, "straightness", "guideway_shape"), tilts, push=push)


# Shapes of a guideway by place as a share of its span, a shift of the middle, and a skew.
GUIDEWAYS: Mapping[str, Callable[[Floats, float, float], Floats]] = {
    "bump": lambda at, shift, skew: np.exp(-(((at - shift) / 0.5) ** 2)),
    "step": lambda at, shift, skew: np.tanh((at - shift) / 0.35),
    "kink": lambda at, shift, skew: np.sqrt((at - 0.5 * shift) ** 2 + 0.15**2),
    "cubic": lambda at, shift, skew: at**2 + 0.8 * skew * at**3,
    "cosine": lambda at, shift, skew: np.cos(np.pi * at / 1.3 + shift),
}


def lateral(axis: str, toward: str, signed_um: float, rng: np.random.Generator) -> Fault:
    way_mm = rng.uniform(0.1, 1.5)

    def push(motion: Motion) -> dict[str, Floats]:
        if not {axis, toward} <= set(motion.place_mm):
            return {}
        return {toward: 0.5 * signed_um * _leaning(motion.speed_mm_s[axis] * STEP_S, way_mm)}

    return Fault("lateral", axis, _labels(axis, "lateral_play", "lateral_play_taper"), push=push)


def door(um: float) -> Fault:
    """Return a door that rubs where Y is high and going up, and lets go in a snap."""

    def push(motion: Motion) -> dict[str, Floats]:
        at = motion.place_mm["Y"] / motion.radius_mm
        rubs = 1.0 / (1.0 + np.exp(-(at - 0.55) / 0.02)) / (1.0 + np.exp(-(0.93 - at) / 0.006))
        return {"X": um * rubs * (motion.speed_mm_s["Y"] > 0.0) * (at - 0.3)}

    return Fault("door", "X", push=push)


def hose(um: float) -> Fault:
    """Return a hose, a spring that stiffens with X and creeps within 1.2 s."""

    def push(motion: Motion) -> dict[str, Floats]:
        pull = np.log1p(np.exp((motion.place_mm["X"] + 0.4 * motion.radius_mm) / 22.0))
        return {"Y": um * (0.4 * pull + 0.6 * _creeping(pull, STEP_S / 1.2)) / 3.0}

    return Fault("hose", "X", push=push)


def chain(um: float) -> Fault:
    """Return a cable chain that pulls by place and by direction, in loops over a length of chain."""

    def push(motion: Motion) -> dict[str, Floats]:
        x = motion.place_mm["X"]
        leans = _leaning(motion.speed_mm_s["X"] * STEP_S, 9.0)
        aside = 0.5 * np.arctan((x + 20.0) / 25.0) + 0.6 * leans * np.cos(x / 55.0) ** 2
        return {"Y": um * aside, "X": 0.5 * um * leans * np.maximum(0.0, x / motion.radius_mm) ** 2}

    return Fault("chain", "X", push=push)


def cover(um: float) -> Fault:
    """Return a telescopic cover whose sheets knock at three places on the way up; the head swings."""

    def push(motion: Motion) -> dict[str, Floats]:
        x = motion.place_mm["X"]
        knocks = np.zeros(x.size)
        for at in (-61.0, -14.0, 37.0):
            if abs(at) <= motion.radius_mm:
                knocks[np.flatnonzero((x[:-1] < at) & (x[1:] >= at))] = 1.0
        return {"Y": um * _swinging(knocks, 2.0 * math.pi * 3.1, 0.12)}

    return Fault("cover", "X", push=push)


UNKNOWN: tuple[Callable[[float], Fault], ...] = (door, hose, chain, cover)


@njit(error_model="numpy")  # type: ignore[untyped-decorator]
def _leaning(step_mm: Floats, way_mm: float) -> Floats:
    """Return to which side a carriage leans, -1 to 1, taken up over a way after each reversal."""
    out = np.empty(step_mm.size)
    side = 0.0
    for i in range(step_mm.size):
        side += ((1.0 if step_mm[i] > 0.0 else -1.0) - side) * abs(step_mm[i]) / way_mm
        out[i] = side
    return out


@njit(error_model="numpy")  # type: ignore[untyped-decorator]
def _creeping(pull: Floats, share: float) -> Floats:
    """Return a pull that is followed by a share of what is left in each step."""
    out = np.empty(pull.size)
    now = pull[0]
    for i in range(pull.size):
        now += share * (pull[i] - now)
        out[i] = now
    return out


@njit(error_model="numpy")  # type: ignore[untyped-decorator]
def _swinging(knocks: Floats, omega: float, damping: float) -> Floats:
    """Return how a head swings after knocks, each of a speed of ``omega``."""
    out = np.empty(knocks.size)
    place, speed = 0.0, 0.0
    for i in range(knocks.size):
        speed += knocks[i] * omega - (2.0 * damping * omega * speed + omega**2 * place) * STEP_S
        place += speed * STEP_S
        out[i] = place
    return out


def _sign(rng: np.random.Generator) -> float:
    return float(rng.choice([-1.0, 1.0]))


def drawn(
    kinds: tuple[str, ...],
    count: int,
    design: Design,
    centre_mm: Mapping[str, float],
    noise_um: float,
    rng: np.random.Generator,
) -> list[Fault]:
    """Return faults of different kinds or axes; of one plane one scale, of a machine one loop, and heat or drift."""
    out: list[Fault] = []
    taken: set[str] = set()
    while len(out) < count:
        kind = str(rng.choice(kinds))
        axis = str(rng.choice(list(design.planes) if kind == "squareness" else design.axes))
        key = _key(kind, axis, design)
        if key not in taken:
            taken.add(key)
            out.append(_one(kind, axis, design, centre_mm, noise_um, rng))
    return out


def _key(kind: str, axis: str, design: Design) -> str:
    """Return what there can be only one of."""
    if kind in ("heat", "drift"):
        return "by time"
    whole = kind in ("kv_mismatch", "servo_lag") or (kind == "scale" and len(design.axes) == 2)
    return kind if whole else f"{kind} {axis}"


def _one(
    kind: str, axis: str, design: Design, centre_mm: Mapping[str, float], noise_um: float, rng: np.random.Generator
) -> Fault:
    um = math.exp(rng.uniform(math.log(max(_LEAST_UM, 5.0 * noise_um)), math.log(_MOST_UM)))
    signed_um = _sign(rng) * um
    radius, feed = max(design.radii_mm), max(design.feeds_mm_min)
    beside = sorted({b for plane in design.planes for b in PLANES[plane] if axis in PLANES[plane]} - {axis})
    plane = next((plane for plane in design.planes if plane == axis), design.planes[0])
    makes: dict[str, Callable[[], Fault]] = {
        "backlash": lambda: backlash(axis, um, centre_mm[axis], rng),
        "friction": lambda: friction(axis, um, rng),
        "cyclic": lambda: cyclic(axis, um, rng),
        "scale": lambda: scale(axis, signed_um, radius),
        "squareness": lambda: squareness(plane, signed_um, radius),
        "kv_mismatch": lambda: kv_mismatch(axis, signed_um, feed),
        "servo_lag": lambda: servo_lag(rng),
        "mode": lambda: mode(axis, um, (feed / 60.0) ** 2 / min(design.radii_mm), rng),
        "straightness": lambda: straightness(axis, str(rng.choice(beside)), signed_um, radius, rng),
        "lateral": lambda: lateral(axis, str(rng.choice(beside)), signed_um, rng),
        "heat": lambda: heat(axis, rng),
        "drift": lambda: drift(axis, rng),
    }
    return makes[kind]()
