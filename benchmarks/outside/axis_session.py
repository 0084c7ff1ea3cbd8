"""A positioning test of the outside axis with a laser: where it stops and when, what is read, and what is logged."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta

import numpy as np
from axis_faults import UNKNOWN, Fault, Visits, drawn, spoilt, wandering

from dtwin.schema import Campaign, Floats, Run, RunMeta

_BEGUN = datetime(2026, 3, 2, 8, tzinfo=UTC)
_SEED = 909
# What a row is to the random numbers.
_STREAMS: Mapping[str, int] = {"null": 0, "full": 1, "unknown": 2, "spoilt": 3}
_CHANNELS_SEED = 7
# Designs of the machines of a row, in turn.
_TURNS = ("iso", "dense", "three", "equal", "oneway", "iso", "dense", "iso")
_TURNS_OF_ROW: Mapping[str, tuple[str, ...]] = {
    "unknown": ("iso", "dense", "three", "dense", "equal", "iso"),
    "spoilt": ("iso", "dense", "equal", "dense"),
}
# From, and below.
_TARGETS: Mapping[str, tuple[int, int]] = {
    "iso": (11, 26),
    "dense": (34, 51),
    "three": (15, 35),
    "equal": (11, 31),
    "oneway": (15, 40),
}
_OVER_MM, _TURNING_S = 5.0, 3.0


@dataclass(frozen=True)
class Axis:
    """A measured axis.

    Attributes:
        read_um: What the laser shows at each visit. Shape (n,).
        temperature_c: What a thermometer shows; logged at each visit, or once a run. Shape (n,).
        air: Whether temperature and humidity of the air are logged.
    """

    name: str
    visits: Visits
    feed_mm_min: float
    faults: tuple[Fault, ...]
    noise_um: float
    read_um: Floats
    temperature_c: Floats | None
    each_visit: bool
    air: bool
    pitch_stated: bool


def axis(row: str, number: int) -> Axis:
    """Return a machine of a row; the same for the same number."""
    rng = np.random.default_rng([_SEED, _STREAMS[row], number])
    turns = _TURNS_OF_ROW.get(row, _TURNS)
    design = turns[number % len(turns)]
    visits, feed = _visits(design, rng)
    noise_um = float(rng.choice([0.1, 0.2, 0.3, 0.5]))
    visits = replace(visits, thermometer=bool(rng.random() < 0.5))
    air, each_visit = bool(rng.random() < 0.6), bool(rng.random() < 0.4)
    count = {"null": 0, "full": 2 + number % 4, "unknown": 2, "spoilt": 2}[row]
    faults = [mechanism(visits, rng) for mechanism in drawn(count, design != "oneway", rng)]
    if row == "unknown":
        faults.append(UNKNOWN[number % len(UNKNOWN)](visits, rng))
    if row == "spoilt":
        faults.append(spoilt(visits, rng))
    temperature = next((fault.temperature_c for fault in faults if fault.temperature_c is not None), None)
    if visits.thermometer and temperature is None:
        # It is logged though nothing depends on it.
        temperature = 20.3 + 0.15 * visits.time_s / 3600.0 + 0.08 * wandering(visits.time_s, 900.0, rng)
    read = sum((fault.um for fault in faults), np.zeros(visits.time_s.size)) + _noise(visits, noise_um, rng)
    # The laser is set to zero at the first reading.
    read = read - read[0]
    stated = bool(rng.random() < 0.7)
    name = f"{row}-{number}"
    return Axis(name, visits, feed, tuple(faults), noise_um, read, temperature, each_visit, air, stated)


def _visits(design: str, rng: np.random.Generator) -> tuple[Visits, float]:
    """Return the visits of a design, and the feed between them."""
    travel_mm = float(rng.choice([300.0, 400.0, 500.0, 600.0, 800.0, 1000.0, 1200.0, 1500.0]))
    pitch_mm = float(rng.choice([5.0, 10.0, 12.0, 16.0, 20.0]))
    targets_mm = _targets(design, travel_mm, rng)
    feed = float(rng.choice([1000.0, 2000.0, 5000.0]))
    dwell_s = rng.uniform(2.0, 5.0)
    start_mm = float(rng.choice([-0.5 * travel_mm, 0.0, 25.0]))
    time_s = 0.0
    out: list[tuple[float, float, float, int, float]] = []
    for run in range(3 if design == "three" else 5):
        for side, order in ((1.0, targets_mm), (-1.0, targets_mm[::-1])):
            last = order[0] - side * _OVER_MM
            for at in order:
                time_s += abs(at - last) / feed * 60.0 + dwell_s
                last = at
                if side > 0.0 or design != "oneway":
                    out.append((time_s, at + start_mm, side, run, abs(at - order[0]) + _OVER_MM))
            time_s += _TURNING_S
        time_s += rng.uniform(10.0, 40.0)
    times, places, sides, runs, since = (np.array(column) for column in zip(*out, strict=True))
    return Visits(times, places, sides, runs, since, travel_mm, start_mm, pitch_mm), feed


def _targets(design: str, travel_mm: float, rng: np.random.Generator) -> Floats:
    """Return the targets from 0, shape (n,): evenly spaced in millimetres, or each moved aside at random."""
    # A number is drawn for every design, so that all draw alike.
    counts = {name: int(rng.integers(*between)) for name, between in _TARGETS.items()}
    at_mm: Floats = np.linspace(0.0, travel_mm, counts[design])
    if design == "equal":
        return at_mm.round()
    at_mm = at_mm + rng.uniform(-0.35, 0.35, at_mm.size) * (travel_mm / (at_mm.size - 1))
    at_mm = (at_mm - at_mm.min()).round(3)
    return at_mm.round(1) if design == "iso" else at_mm


def _noise(visits: Visits, um: float, rng: np.random.Generator) -> Floats:
    """Return noise, shape (n,): white, air that wanders more on a longer beam, and a zero of each run."""
    white = rng.normal(size=visits.time_s.size)
    air = wandering(visits.time_s, rng.uniform(40.0, 150.0), rng) * (0.4 + 0.9 * visits.share)
    zero = rng.normal(size=visits.run.max() + 1)[visits.run]
    out: Floats = um * (0.75 * white + 0.55 * air + 0.25 * zero)
    return out


def measured(machine: Axis) -> tuple[Campaign, list[Run]]:
    """Return the campaign of a machine."""
    visits, rng = machine.visits, np.random.default_rng(_CHANNELS_SEED)
    air_c = 20.6 + 0.2 * visits.time_s / 3600.0 + 0.1 * wandering(visits.time_s, 600.0, rng)
    humidity_pct = 45.0 + 2.0 * wandering(visits.time_s, 1500.0, rng)
    runs = []
    for number in range(visits.run.max() + 1):
        here = visits.run == number
        samples = {
            "t_s": visits.time_s[here] - visits.time_s[here][0],
            "position_mm": visits.at_mm[here],
            "direction": np.where(visits.side[here] > 0.0, "forward", "reverse").astype(object),
            "error_um": machine.read_um[here],
        }
        covariates = {}
        if machine.temperature_c is not None:
            shown_c = machine.temperature_c[here] + 0.03 * rng.normal(size=here.sum())
            if machine.each_visit:
                samples["temperature_c"] = shown_c
            else:
                covariates["temperature_c"] = float(shown_c.mean())
        if machine.air:
            covariates["air_temperature_c"] = float(air_c[here].mean())
            covariates["humidity_pct"] = float(humidity_pct[here].mean())
        meta = RunMeta(
            run_id(number),
            kind="linear",
            condition={"axis": "X", "feed_mm_min": machine.feed_mm_min},
            repeat=number + 1,
            started=(_BEGUN + timedelta(seconds=float(visits.time_s[here][0]))).isoformat(),
            covariates=covariates,
        )
        runs.append(Run(meta, samples))
    geometry = {"screw_pitch_mm": visits.pitch_mm} if machine.pitch_stated else {}
    campaign = Campaign(
        machine.name,
        f"mc-{machine.name}",
        kind="linear",
        started=_BEGUN.isoformat(),
        machine_geometry=geometry,
        instrument={"model": "laser"},
    )
    return campaign, runs


def run_id(number: int) -> str:
    """Return the name of a run."""
    return f"r{number + 1}"


def spoilt_runs(faults: Sequence[Fault]) -> tuple[str, ...]:
    """Return the runs that are spoilt."""
    return tuple(run_id(fault.spoils) for fault in faults if fault.spoils is not None)
