"""A positioning axis with a screw, made of mechanisms: what a laser reads at the targets.

Shares nothing with ``dtwin.physics``. Leads wander along the screw, waves are not sines, wear has
soft ends, screws are not equally warm all along: the laws of the library hold nearly, as on machines.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np
from scipy.interpolate import CubicSpline

from dtwin.schema import Campaign, Floats, Run, RunMeta

RUNS = 5
_RUN_MINUTES = 12.0
_SPENT = 0.8
_BEGUN = datetime(2026, 3, 2, 8, tzinfo=UTC)
# Logged beside the temperature; most of them have nothing to do with the error.
CHANNELS = ("humidity_pct", "supply_v", "oil_c", "pressure_kpa")
_ROUGH = 0.05


@dataclass(frozen=True)
class Stand:
    """Where and when the axis was measured; arrays broadcast to (runs, 2, targets).

    Attributes:
        at_mm: Targets, from the near end of the travel. Shape (1, 1, targets).
        side: Flank that the nut bears on: +1 forward, -1 reverse. Shape (1, 2, 1).
        travel_mm, pitch_mm: Length of the travel; way of a turn of the screw.
        hours, warmth_k: Time since the first run, and rise of temperature over its mean. Shape (runs, 2, targets).
        channels: What else was logged, of mean zero and size one. Shape (runs, 1, 1) each.
        rng: What a mechanism draws of its own.
    """

    at_mm: Floats
    side: Floats
    travel_mm: float
    pitch_mm: float
    hours: Floats
    warmth_k: Floats
    channels: dict[str, Floats]
    rng: np.random.Generator

    @property
    def share(self) -> Floats:
        """Targets as shares of the travel."""
        return self.at_mm / self.travel_mm

    def rough(self) -> Floats:
        """Return one plus a twentieth of something that changes slowly along the axis."""
        knots = self.rng.standard_normal(6)
        along = np.interp(self.share, np.linspace(0.0, 1.0, 6), knots)
        return 1.0 + _ROUGH * (along - along.mean())

    def summed(self, density: Floats) -> Floats:
        """Return the integral of a density from the near end of the travel."""
        steps = np.diff(self.at_mm, axis=2) * 0.5 * (density[..., 1:] + density[..., :-1])
        return np.concatenate([np.zeros_like(density[..., :1]), np.cumsum(steps, axis=2)], axis=2)


Mechanism = Callable[[Stand], Floats]


def _lead(s: Stand) -> Floats:
    """A thread that was cut too long, not equally everywhere."""
    return s.summed(s.rough())


def _wander(s: Stand) -> Floats:
    """The lead wanders: a leaning wave whose height changes."""
    turn = 2.0 * np.pi * (s.at_mm / s.rng.uniform(60.0, 0.5 * s.travel_mm) + s.rng.uniform())
    return s.rough() * np.sin(turn + 0.25 * np.sin(turn))


def _play(s: Stand) -> Floats:
    """Lost motion of nut and bearings."""
    return -s.side * s.rough()


def _taper(s: Stand) -> Floats:
    """Preload that was set in the middle, on a screw that is thinner at one end."""
    off = 2.0 * s.share - 1.0
    return -s.side * np.sign(off) * np.abs(off) ** s.rng.uniform(0.9, 1.15)


def _wear(s: Stand) -> Floats:
    """A stretch that is worn evenly, with soft ends."""
    middle, half = s.rng.uniform(0.25, 0.75), s.rng.uniform(0.08, 0.2)
    soft = s.rng.uniform(0.15, 0.35) * half
    up, down = (np.tanh((s.share - middle + e) / soft) for e in (half, -half))
    return -s.side * (up - down)


def _turn(s: Stand) -> Floats:
    """Thread and thrust bearing run out within a turn."""
    angle = 2.0 * np.pi * s.at_mm / s.pitch_mm
    size = np.array([1.0, *s.rng.uniform(0.1, 0.5, 2)])
    waves = [a * np.cos(k * angle + s.rng.uniform(0.0, 6.28)) for k, a in enumerate(size, 1)]
    return s.rough() * np.sum(waves, axis=0)


def _flanks(s: Stand) -> Floats:
    """A nut that tilts: the flanks run out differently."""
    return s.side * _turn(s)


def _growth(s: Stand) -> Floats:
    """A screw that is held at one end and not equally warm."""
    grown = s.summed(s.rough())
    return s.warmth_k * (grown - grown[..., -1:] * (s.rng.random() < 0.5))


def _creep(s: Stand) -> Floats:
    """The bracket of the laser settles."""
    return -np.expm1(-s.hours / s.rng.uniform(2.0, 5.0)) * np.ones_like(s.at_mm)


def _flank_wave(s: Stand) -> Floats:
    """A gear in the drive: a wave that one flank follows more than the other."""
    turn = 2.0 * np.pi * (s.at_mm / s.rng.uniform(125.0, 150.0) + s.rng.uniform())
    return s.side * (np.sin(turn) + 0.2 * np.sin(2.0 * turn))


def _dent(s: Stand) -> Floats:
    """A dent of the guideway that the carriage dips into."""
    off = (s.share - s.rng.uniform(0.2, 0.8)) * s.travel_mm / s.rng.uniform(20.0, 40.0)
    return 1.0 / (1.0 + off**4)


def _bowed(s: Stand) -> Floats:
    """A column that leans with the overhang."""
    return np.abs(s.share - 0.5) ** 1.5


def _tilted(s: Stand) -> Floats:
    """A slide on two shoes tilts on a way that nobody scraped straight, and is measured above the scale."""
    shoes_mm = s.rng.uniform(0.15, 0.35) * s.travel_mm
    knots_mm = np.linspace(-0.5, 1.5, 13) * s.travel_mm
    way = CubicSpline(knots_mm, s.rng.standard_normal(len(knots_mm)))
    return np.asarray(way(s.at_mm + 0.5 * shoes_mm) - way(s.at_mm - 0.5 * shoes_mm))


def _moved(channel: str) -> Mechanism:
    """Return light through air that changes: in proportion to the way from the laser, and a dead path."""

    def act(s: Stand) -> Floats:
        return s.channels[channel] * (s.rng.uniform(-0.3, 0.3) + s.share) * s.rough()

    return act


LIBRARY: dict[str, tuple[Mechanism, str]] = {
    "lead_error": (_lead, "X"),
    "pitch_error": (_wander, "X"),
    "backlash": (_play, "X"),
    "backlash_taper": (_taper, "X"),
    "worn_screw": (_wear, "X"),
    "screw_error": (_turn, "X"),
    "screw_error_by_direction": (_flanks, "X"),
    "thermal_growth": (_growth, ""),
    "thermal_drift": (_creep, ""),
}
# Smooth curves, the same both ways, that a table of pitch errors takes out, whatever makes them.
CURVES: dict[str, Mechanism] = {"power": _bowed, "tilt": _tilted}
FOREIGN: dict[str, Mechanism] = {"flank": _flank_wave, "dent": _dent}
FOREIGN |= {name: _moved(name) for name in CHANNELS}


def mechanism(name: str) -> tuple[str, Mechanism]:
    """Return the label that is right for a mechanism, and the mechanism."""
    if name in FOREIGN:
        return name, FOREIGN[name]
    if name in CURVES:
        return "pitch_error X", CURVES[name]
    act, axis = LIBRARY[name]
    return f"{name} {axis}".strip(), act


def measured(
    acting: Sequence[Mechanism], sizes_um: Sequence[float], noise_um: float, rng: np.random.Generator
) -> tuple[Campaign, list[Run]]:
    """Return a campaign of positioning runs.

    Args:
        acting: What is wrong.
        sizes_um: RMS of what each alone shows once the datum is taken out.
        noise_um: RMS of a run about the mean of all runs.
        rng: Draws the axis, what the mechanisms draw, and the noise.
    """
    stand = _stand(rng)
    error_um = _noise(stand, noise_um)
    for act, size_um in zip(acting, sizes_um, strict=True):
        shows = act(stand) * np.ones_like(error_um)
        shows = shows - shows.mean()
        error_um += size_um * rng.choice((-1.0, 1.0)) * shows / np.sqrt((shows**2).mean())
    turns = {_turn, _flanks} & set(acting)
    # The pitch of a screw is stated where it is known.
    geometry = {"screw_pitch_mm": stand.pitch_mm} if turns or rng.random() < 0.5 else {}
    campaign = Campaign("axis", "virtual-axis", kind="linear", machine_geometry=geometry)
    return campaign, [_run(stand, number, error_um[number]) for number in range(RUNS)]


def _stand(rng: np.random.Generator) -> Stand:
    pitch_mm = float(rng.choice((5.0, 10.0, 20.0)))
    n, apart_mm = int(rng.integers(25, 46)), float(rng.integers(9, 25))
    # ISO 230-2: evenly, and a share of the pitch that differs from target to target.
    at_mm = np.round(apart_mm * np.arange(n) + pitch_mm * rng.uniform(0.0, 0.8, n), 3)
    at_mm -= at_mm[0]
    begun = np.arange(RUNS) + 0.1 * rng.uniform(size=RUNS)
    spent = np.linspace(0.0, _SPENT, 2 * n).reshape(2, n)
    spent[1] = spent[1, ::-1]
    hours = (begun[:, None, None] + spent) * _RUN_MINUTES / 60.0
    # Warm from work, then a stop: it cools down again.
    top, end = rng.uniform(0.3, 0.7) * hours.max(), hours.max()
    warmth = 1.5 * np.minimum(hours / top, (end - hours) / (end - top))
    warmth += 0.1 * rng.standard_normal((RUNS, 1, 1))
    walks = {name: np.cumsum(rng.standard_normal(RUNS)) for name in CHANNELS}
    return Stand(
        at_mm=at_mm[None, None],
        side=np.array([1.0, -1.0])[None, :, None],
        travel_mm=float(at_mm[-1]),
        pitch_mm=pitch_mm,
        hours=hours,
        warmth_k=warmth - warmth.mean(),
        channels={k: ((v - v.mean()) / v.std())[:, None, None] for k, v in walks.items()},
        rng=rng,
    )


def _noise(stand: Stand, rms_um: float) -> Floats:
    """Return what repeats disagree by: reading, air that moves slowly, and where the run began."""
    rng, shape = stand.rng, (RUNS, 2, stand.at_mm.size)
    air = np.cumsum(rng.standard_normal(shape), axis=2)
    air -= air.mean(axis=2, keepdims=True)
    parts = [rng.standard_normal(shape), air / air.std(), rng.standard_normal((RUNS, 1, 1))]
    weights = np.array([0.8, 0.5, 0.33])
    weights *= rms_um / np.linalg.norm(weights)
    return sum((w * p for w, p in zip(weights, parts, strict=True)), np.zeros(shape))


def _run(stand: Stand, number: int, error_um: Floats) -> Run:
    at_mm = stand.at_mm.ravel()
    logged = {name: 50.0 + 5.0 * v[number].item() for name, v in stand.channels.items()}
    hours = _in_order(stand.hours[number])
    begun = _BEGUN + timedelta(hours=float(hours[0]))
    meta = RunMeta(
        f"r{number + 1}",
        kind="linear",
        condition={"axis": "X"},
        repeat=number + 1,
        started=begun.isoformat(),
        covariates=logged,
    )
    ways = np.repeat(np.array(["forward", "reverse"], dtype=object), at_mm.size)
    return Run(
        meta,
        {
            "t_s": 3600.0 * (hours - hours[0]),
            "position_mm": _in_order(np.stack([at_mm, at_mm])),
            "direction": ways,
            "error_um": _in_order(error_um),
            "temperature_c": 20.0 + _in_order(stand.warmth_k[number]),
        },
    )


def _in_order(values: Floats) -> Floats:
    """Return values forward and reverse, shape (2, n), as they were taken."""
    return np.concatenate([values[0], values[1, ::-1]])
