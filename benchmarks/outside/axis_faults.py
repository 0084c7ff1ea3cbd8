"""What can be wrong with the outside axis: the error that a laser sees at each visit of a target, and its right names.

No code and no formula is shared with dtwin. Each mechanism draws its own sizes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dtwin.schema import Floats

_SHORT_WAVE_MM = 0.1  # no target resolves a wave that is shorter
_STEEL_N_MM2, _SHEAR_N_MM2, _GROWTH_UM_MM_K = 210e3, 81e3, 11.5e-3


@dataclass(frozen=True)
class Visits:
    """When and where the laser was read; arrays have the shape (n,), in the order of time.

    Attributes:
        side: +1 forward, -1 reverse.
        run: Counts from 0; a run goes there and back.
        since_mm: Way since the axis turned round.
        start_mm: Place of the first target, from which the travel goes on.
        thermometer: Whether a temperature is logged.
    """

    time_s: Floats
    at_mm: Floats
    side: Floats
    run: NDArray[np.int64]
    since_mm: Floats
    travel_mm: float
    start_mm: float
    pitch_mm: float
    thermometer: bool = False

    @property
    def along_mm(self) -> Floats:
        """Places from the first target."""
        return self.at_mm - self.start_mm

    @property
    def share(self) -> Floats:
        """Places as shares of the travel."""
        return self.along_mm / self.travel_mm

    @property
    def turned(self) -> Floats:
        """Angle of the screw, rad."""
        return 2.0 * np.pi * self.at_mm / self.pitch_mm


@dataclass(frozen=True)
class Fault:
    """One thing that is wrong.

    Attributes:
        um: What it adds to the error at each visit. Shape (n,).
        names, consequences: Effects of dtwin that name it, and those that are true of the axis because of it.
        temperature_c: What a thermometer reads that is beside it. Shape (n,).
        spoils: The run that it spoils.
    """

    kind: str
    um: Floats
    names: frozenset[str] = frozenset()
    consequences: frozenset[str] = frozenset()
    temperature_c: Floats | None = None
    spoils: int | None = None

    def __str__(self) -> str:
        return self.kind

    @property
    def rms_um(self) -> float:
        """What it makes alone."""
        return float(np.sqrt(np.mean((self.um - self.um.mean()) ** 2)))


Mechanism = Callable[[Visits, np.random.Generator], Fault]
_CURVE = frozenset(["lead_error", "pitch_error"])
_WAVES = frozenset(["screw_error", "screw_error_by_direction", "periodic_error"])
_PLAY = frozenset(["backlash", "backlash_taper"])
_WARM = frozenset(["thermal_shift", "thermal_drift", "lead_error"])


def wandering(time_s: Floats, fading_s: float, rng: np.random.Generator) -> Floats:
    """Return what wanders about zero and forgets within ``fading_s``, of unit variance, shape (n,)."""
    out = rng.normal(size=time_s.size)
    for i, keep in enumerate(np.exp(-np.diff(time_s) / fading_s), start=1):
        out[i] = keep * out[i - 1] + math.sqrt(1.0 - keep * keep) * out[i]
    return out


def _sign(rng: np.random.Generator) -> float:
    return float(rng.choice([-1.0, 1.0]))


def _drawn_size(shape: Floats, rng: np.random.Generator) -> Floats:
    """Return a shape with an RMS of 1 to 4 µm about its mean."""
    centred: Floats = shape - shape.mean()
    rms = np.sqrt(np.mean(centred**2))
    um = rng.uniform(1.0, 4.0)
    return centred * (um / rms) if rms > 0.0 else centred


def _wave(angle: Floats, rng: np.random.Generator) -> Floats:
    out: Floats = np.sin(angle + rng.uniform(0.0, 6.0))
    return out


def lead_const(visits: Visits, rng: np.random.Generator) -> Fault:
    """The scale is 5 to 40 µm too long or too short on each metre."""
    um_mm = _sign(rng) * rng.uniform(5.0, 40.0) * 1e-3
    return Fault("lead_const", um_mm * visits.along_mm, frozenset(["lead_error"]))


def lead_walk(visits: Visits, rng: np.random.Generator) -> Fault:
    """The lead of the screw wanders from place to place as it was ground."""
    count, wide, margin = int(visits.travel_mm) + 401, 12, 200
    steps = rng.normal(size=count)
    window = np.exp(-0.5 * (np.arange(-3 * wide, 3 * wide + 1) / wide) ** 2)
    window /= window.sum()
    ends = rng.normal(size=(2, window.size))
    smooth = np.convolve(np.concatenate([ends[0], steps, ends[1]]), window, "same")[window.size : -window.size]
    shape = np.interp(visits.along_mm + margin, np.arange(count), np.cumsum(smooth))
    return Fault("lead_walk", _drawn_size(shape, rng), _CURVE)


def lead_smooth(visits: Visits, rng: np.random.Generator) -> Fault:
    """The scale or the screw is stretched unevenly: a slope, a bow and part of a long wave."""
    share = visits.share
    shape = rng.normal() * 1.5 * share + rng.normal() * (share - 0.5) ** 2 * 4.0
    shape += rng.normal() * np.sin(np.pi * rng.uniform(1.2, 3.0) * share + rng.uniform(0.0, 6.0)) * 0.7
    return Fault("lead_smooth", _drawn_size(shape, rng), _CURVE)


def abbe(visits: Visits, rng: np.random.Generator) -> Fault:
    """A bent guideway tilts the carriage on its two blocks, and the laser is above the scale."""
    mesh = np.arange(int(visits.travel_mm) + 801) - 400.0
    half_base_mm, wide = 100.0, 301
    height = np.interp(mesh, np.linspace(-400.0, visits.travel_mm + 400.0, 7), rng.normal(size=7))
    window = np.hanning(wide)
    height = np.convolve(np.pad(height, wide // 2, "edge"), window / window.sum(), "valid")
    before, behind = (np.interp(visits.along_mm + d, mesh, height) for d in (half_base_mm, -half_base_mm))
    return Fault("abbe", _drawn_size((before - behind) / (2.0 * half_base_mm), rng), _CURVE)


def periodic(visits: Visits, rng: np.random.Generator) -> Fault:
    """The screw runs out: waves with its pitch, in half of the machines other ones on the way back."""
    um, angle = rng.uniform(0.6, 2.5), visits.turned
    wave = um * _wave(angle, rng)
    wave += um * rng.uniform(0.0, 0.4) * _wave(2.0 * angle, rng)
    wave += um * rng.uniform(0.0, 0.15) * _wave(3.0 * angle, rng)
    if rng.random() < 0.5:
        wave += visits.side * um * rng.uniform(0.2, 0.5) * _wave(angle, rng)
        return Fault("periodic", wave, _WAVES)
    return Fault("periodic", wave, frozenset(["screw_error", "periodic_error"]), _WAVES)


def backlash(visits: Visits, rng: np.random.Generator) -> Fault:
    """The nut has play."""
    return Fault("backlash", -0.5 * rng.uniform(1.0, 8.0) * visits.side, frozenset(["backlash"]))


def taper(visits: Visits, rng: np.random.Generator) -> Fault:
    """The screw is thinner toward one end, where the nut has play."""
    share = visits.share
    toward = np.clip(share if rng.random() < 0.5 else 1.0 - share, 0.0, 1.0)
    play_um, power = rng.uniform(2.0, 7.0), rng.uniform(0.8, 1.5)
    return Fault("taper", -0.5 * play_um * visits.side * toward**power, frozenset(["backlash_taper"]), _PLAY)


def windup(visits: Visits, rng: np.random.Generator) -> Fault:
    """Friction stretches and twists the screw between its fixed bearing and the nut."""
    rubbing_n, thick_mm, free_mm = rng.uniform(60.0, 250.0), rng.uniform(16.0, 32.0), rng.uniform(80.0, 300.0)
    pull_n = _STEEL_N_MM2 * np.pi * thick_mm**2 / 4.0
    twist_n_mm2 = _SHEAR_N_MM2 * np.pi * thick_mm**4 / 32.0
    length_mm = visits.along_mm + free_mm
    gives_mm_n = length_mm / pull_n + length_mm * (visits.pitch_mm / (2.0 * np.pi)) ** 2 / twist_n_mm2
    gives_mm_n += 1.0 / (rng.uniform(80.0, 200.0) * 1e3)
    return Fault("windup", -visits.side * rubbing_n * gives_mm_n * 1e3 * rng.uniform(0.8, 1.2), _PLAY)


def worn(visits: Visits, rng: np.random.Generator) -> Fault:
    """The nut has worn the screw where the axis worked most, one flank more than the other."""
    travel_mm = visits.travel_mm
    mesh = np.arange(-200.0, travel_mm + 201.0)
    middle_mm, spread_mm, half_nut_mm = rng.uniform(0.3, 0.7) * travel_mm, rng.uniform(0.1, 0.22) * travel_mm, 25.0
    use = np.zeros(mesh.size)
    for _ in range(150):
        low, high = np.sort(middle_mm + spread_mm * rng.normal(size=2) * 0.7)
        use += (mesh > low - half_nut_mm) & (mesh < high + half_nut_mm)
    window = np.hanning(61)
    use = np.convolve(use, window / window.sum(), "same")
    wear = np.interp(visits.along_mm, mesh, use / use.max())
    um, share = rng.uniform(1.5, 6.0), rng.uniform(0.3, 0.8)
    flanks = np.where(visits.side > 0.0, -share * um * wear, (1.0 - share) * um * wear)
    return Fault("worn", flanks, frozenset(["worn_screw"]), _PLAY | {"pitch_error"})


def warming(visits: Visits, rng: np.random.Generator) -> Fault:
    """Screw and bed warm up and grow from where they are held, at one end or in the middle."""
    rise_k = rng.uniform(0.8, 3.0)
    fast_s, slow_s, share = rng.uniform(150.0, 400.0), rng.uniform(1500.0, 4000.0), rng.uniform(0.5, 0.8)
    time_s = visits.time_s
    warmth_k = share * (1.0 - np.exp(-time_s / fast_s)) + (1.0 - share) * (1.0 - np.exp(-time_s / slow_s))
    warmth_k *= rise_k
    at_end = rng.random() < 0.7
    held_mm = visits.start_mm + (-rng.uniform(0.0, 150.0) if at_end else 0.5 * visits.travel_mm)
    um = _GROWTH_UM_MM_K * warmth_k * (visits.at_mm - held_mm)
    if not visits.thermometer:
        names = frozenset(["thermal_growth", "thermal_drift", "warming_growth"])
        return Fault("warming_unlogged", um, names, _WARM)
    reads_c = 20.0 + rng.normal() * 0.5 + warmth_k
    return Fault("warming_logged", um, frozenset(["thermal_growth"]), _WARM, reads_c)


def zero_drift(visits: Visits, rng: np.random.Generator) -> Fault:
    """The mount of the laser or of its mirror creeps, ever slower."""
    um, fading_s = _sign(rng) * rng.uniform(1.5, 6.0), rng.uniform(400.0, 3000.0)
    gone = (1.0 - np.exp(-visits.time_s / fading_s)) / (1.0 - np.exp(-visits.time_s[-1] / fading_s))
    return Fault("zero_drift", um * gone, frozenset(["thermal_drift"]), frozenset(["thermal_shift"]))


def room_growth(visits: Visits, rng: np.random.Generator) -> Fault:
    """The axis grows and shrinks with a workshop that warms and cools; a thermometer is logged."""
    swing_k, time_s = rng.uniform(0.5, 1.5), visits.time_s
    turn = 2.0 * np.pi * time_s / rng.uniform(0.7, 1.6) / time_s[-1]
    warmth_k = swing_k * _wave(turn, rng) + 0.1 * wandering(time_s, 300.0, rng)
    held_mm = visits.start_mm - rng.uniform(0.0, 150.0)
    um = rng.uniform(8.0, 13.0) * 1e-3 * warmth_k * (visits.at_mm - held_mm)
    return Fault("room_growth", um, frozenset(["thermal_growth"]), _WARM, 20.0 + warmth_k)


def interp(visits: Visits, rng: np.random.Generator) -> Fault:
    """The scale's reading is uneven within each of its graduation periods of 0.02, 1, 2 or 5 mm."""
    period_mm, um = float(rng.choice([1.0, 2.0, 5.0, 0.02])), rng.uniform(0.4, 1.5)
    angle = 2.0 * np.pi * visits.at_mm / period_mm
    wave = um * _wave(angle, rng) + 0.4 * um * _wave(2.0 * angle, rng)
    if period_mm < _SHORT_WAVE_MM:
        return Fault("interp_fine", wave, consequences=_WAVES)
    return Fault("interp", wave, frozenset(["screw_error", "periodic_error"]), _WAVES)


def spoilt(visits: Visits, rng: np.random.Generator) -> Fault:
    """One run is spoilt: the optics creep, are knocked, or a fan stirs the air in the beam."""
    run, how = int(rng.integers(0, visits.run.max() + 1)), rng.integers(0, 3)
    here = visits.run == run
    if how == 0:
        um = here * rng.uniform(6.0, 15.0) * ((visits.time_s - visits.time_s[here][0]) / 600.0)
    elif how == 1:
        after = np.cumsum(here) > here.sum() * rng.uniform(0.2, 0.8)
        um = here * np.where(after, rng.uniform(5.0, 12.0), 0.0)
    else:
        um = here * rng.uniform(2.0, 5.0) * rng.normal(size=here.size)
    return Fault("spoilt", um, spoils=run)


def dent(visits: Visits, rng: np.random.Generator) -> Fault:
    """The scale or the guideway has a dent at one place."""
    middle_mm = rng.uniform(0.2, 0.8) * visits.travel_mm
    wide_mm = max(rng.uniform(15.0, 40.0), visits.travel_mm / 25.0)
    um: Floats = rng.uniform(4.0, 9.0) * np.exp(-0.5 * ((visits.along_mm - middle_mm) / wide_mm) ** 2)
    return Fault("dent", um)


def door(visits: Visits, rng: np.random.Generator) -> Fault:
    """A door catches the slide past a place, and lets it go later on the way back."""
    middle_mm, late_mm = rng.uniform(0.35, 0.65) * visits.travel_mm, rng.uniform(0.08, 0.2) * visits.travel_mm
    caught = visits.along_mm > np.where(visits.side > 0.0, middle_mm, middle_mm - late_mm)
    return Fault("door", rng.uniform(4.0, 9.0) * caught.astype(np.float64))


def hose(visits: Visits, rng: np.random.Generator) -> Fault:
    """A hose drags: its pull turns round over a way after each reversal, and it stiffens near the far end."""
    way_mm = rng.uniform(40.0, 120.0)
    um: Floats = -visits.side * rng.uniform(3.0, 6.0) * (1.0 - 2.0 * np.exp(-visits.since_mm / way_mm))
    um -= rng.uniform(2.0, 5.0) * np.exp(-(1.0 - visits.share) / 0.08)
    return Fault("hose", um, consequences=frozenset(["backlash", "slow_take_up"]))


ORDINARY: tuple[Mechanism, ...] = (
    lead_const,
    lead_walk,
    lead_smooth,
    abbe,
    periodic,
    backlash,
    taper,
    windup,
    worn,
    warming,
    zero_drift,
    room_growth,
    interp,
)
UNKNOWN: tuple[Mechanism, ...] = (dent, door, hose)
_BETWEEN_DIRECTIONS = (backlash, windup, taper)
# Of each of these an axis has one at most.
_ONE_OF: tuple[tuple[Mechanism, ...], ...] = (
    (lead_walk, lead_smooth, abbe),
    (backlash, windup),
    (taper, windup),
    (warming, room_growth),
    (zero_drift, room_growth),
    (warming, zero_drift),
    (taper, worn),
)


def drawn(count: int, both_ways: bool, rng: np.random.Generator) -> list[Mechanism]:
    """Return different mechanisms that one axis can have together; one way shows nothing between directions."""
    pool = [one for one in ORDINARY if both_ways or one not in _BETWEEN_DIRECTIONS]
    out: list[Mechanism] = []
    while len(out) < count:
        one = pool[rng.integers(len(pool))]
        beside = {other for group in _ONE_OF if one in group for other in group} | {one}
        if not beside & set(out):
            out.append(one)
    return out
