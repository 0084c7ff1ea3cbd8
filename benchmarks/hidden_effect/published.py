"""The published simulated machines as cases: everything that is wrong with one, and nothing told."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rows import PUBLISHED

from dtwin.config import published_table
from dtwin.schema import Campaign, Direction, Floats, Run, RunMeta
from studies.machines.ballbar_simulator import Convention, radial_error_um

_SLOWEST, _USUAL, _FASTEST = 300.0, 1000.0, 6000.0
_PITCHES_MM = (10.0, 12.0, 18.0, 20.0, 38.1, 44.45, 50.0)
# The width of a spike is not published.
_SPIKE_MS, _SPIKE_DEG = 60.0, 3.0
_REPEATS, _SAMPLES = 3, 1080
_CENTRE_UM = (3.0, -2.0)
_WAYS: tuple[tuple[int, Direction], ...] = ((1, "CCW"), (-1, "CW"))
# Entries with a value for each end, or for each direction: what they have in common, and the rest.
_PAIRS = {
    "backlash": ("backlash", "backlash_taper"),
    "lateral_play": ("lateral_play", "lateral_play_taper"),
    "cyclic": ("cyclic_error", "cyclic_error_by_direction"),
}
Table = Mapping[str, Any]


def published_case(
    number: int, noise_um: float, rng: np.random.Generator
) -> tuple[Campaign, list[Run], dict[str, float], tuple[str, ...]]:
    """Return campaign, runs, what shows more than the noise with its RMS in um, and what shows less."""
    name, law = PUBLISHED[number]
    machine = tomllib.loads(published_table("ballbar_simulator.toml").read_text("utf-8"))[name]
    # The fifth is published at 100 mm/min.
    feeds = sorted({min(_SLOWEST, machine["feed"]), float(machine["feed"]), _FASTEST})
    feeds = feeds if len(feeds) == 3 else [feeds[0], _USUAL, _FASTEST]
    return _case(name, machine, feeds, law, noise_um, rng)


def drawn_case(
    number: int, everyday: bool, noise_um: float, rng: np.random.Generator
) -> tuple[Campaign, list[Run], dict[str, float], tuple[str, ...]]:
    """Return what :func:`published_case` does of a machine with the same sorts of faults, drawn; ``everyday``: at one feed."""
    feeds = [_USUAL] if everyday else [_SLOWEST, _USUAL, _FASTEST]
    return _case(f"drawn{number}", _drawn(rng), feeds, ("time", "angle")[number % 2], noise_um, rng)


def _drawn(rng: np.random.Generator) -> Table:
    """Return a machine with 8 to 19 faults, of sizes and at pitches as in the published table."""

    def size(least: float, most: float) -> float:
        return float(rng.choice([-1, 1]) * rng.uniform(least, most))

    def pair(share: float, least: float, most: float) -> list[float]:
        both = [size(least, most), size(least, most)]
        return both if rng.random() < share else [0.0, 0.0]

    machine: dict[str, Any] = {
        "radius": float(rng.choice([50.0, 100.0, 150.0])),
        "scale_x": size(5.0, 40.0),
        "scale_y": size(5.0, 40.0),
        "squareness": pair(0.9, 5.0, 35.0)[0],
        "servo_mismatch": pair(0.6, 0.02, 0.3)[0],
    }
    for low in "xy":
        machine |= {
            f"straightness_{low}": pair(0.8, 1.0, 20.0)[0],
            f"cyclic_{low}": pair(0.6, 0.5, 6.0),
            f"pitch_{low}": float(rng.choice(_PITCHES_MM)),
            f"backlash_{low}": pair(0.8, 0.2, 8.0),
            f"lateral_play_{low}": pair(0.6, 0.3, 12.0),
            f"reversal_spike_{low}": pair(0.7, 1.0, 4.0),
        }
    return machine


def _case(
    name: str, machine: Table, feeds: Sequence[float], law: str, noise_um: float, rng: np.random.Generator
) -> tuple[Campaign, list[Run], dict[str, float], tuple[str, ...]]:
    rms = {label: _shows_um(part, feeds, law) for label, part in _parts(machine).items()}
    asked = {label: value for label, value in rms.items() if value >= noise_um}
    also = tuple(label for label, value in rms.items() if 0.0 < value < noise_um)
    return Campaign(name, name), measured(machine, feeds, law, noise_um, rng), asked, also


def _parts(machine: Table) -> dict[str, dict[str, Any]]:
    """Return the machine with nothing but one effect, by the label of the effect."""
    size = {"radius": machine["radius"]}
    out: dict[str, dict[str, Any]] = {
        "scale_mismatch XY": {key: machine[key] for key in ("scale_x", "scale_y")},
        "squareness XY": {"squareness": machine["squareness"]},
        "servo_mismatch XY": {"servo_mismatch": machine.get("servo_mismatch", 0.0)},
    }
    for axis in "XY":
        low = axis.lower()
        out[f"straightness {axis}"] = {f"straightness_{low}": machine[f"straightness_{low}"]}
        spike = f"reversal_spike_{low}"
        out[f"reversal_spike {axis}"] = {spike: machine.get(spike, [0.0, 0.0])}
        for key, (mean_of, rest_of) in _PAIRS.items():
            one, other = machine.get(f"{key}_{low}", (0.0, 0.0))
            mean, rest = 0.5 * (one + other), 0.5 * (one - other)
            pitch = {f"pitch_{low}": machine.get(f"pitch_{low}", 10.0)}
            out[f"{mean_of} {axis}"] = {f"{key}_{low}": [mean, mean]} | pitch
            out[f"{rest_of} {axis}"] = {f"{key}_{low}": [rest, -rest]} | pitch
    none = {
        "scale_x": 0.0,
        "scale_y": 0.0,
        "squareness": 0.0,
        "straightness_x": 0.0,
        "straightness_y": 0.0,
        "backlash_x": [0.0, 0.0],
        "backlash_y": [0.0, 0.0],
    }
    return {label: none | size | part for label, part in out.items()}


def _error_um(machine: Table, feed: float, sense: int, angle_rad: Floats, law: str) -> Floats:
    """Return the error of a machine, with spikes constant in ``time`` or in ``angle``."""
    in_time = float(np.degrees(1e-3 * _SPIKE_MS * feed / 60.0 / machine["radius"]))
    width_deg = in_time if law == "time" else _SPIKE_DEG
    # The signs of dtwin's own effects.
    made = Convention(1, 1, 1, 1, 1, 1, (0.4, 1.1), width_deg)
    return radial_error_um(machine, feed, sense, angle_rad, made)


def _shows_um(machine: Table, feeds: Sequence[float], law: str) -> float:
    """Return the RMS that a machine shows when one centre and one radius are taken out."""
    angle = np.radians(np.arange(0.25, 360.0, 0.5))
    out = np.array([_error_um(machine, f, s, angle, law) for f in feeds for s, _ in _WAYS])
    shapes = np.stack([np.ones(angle.size), np.cos(angle), np.sin(angle)])
    out -= (shapes @ out.mean(axis=0) / (shapes**2).sum(axis=1)) @ shapes
    return float(np.sqrt((out**2).mean()))


def measured(machine: Table, feeds: Sequence[float], law: str, noise_um: float, rng: np.random.Generator) -> list[Run]:
    """Return three repeats of every feed and direction, in random order, about a centre that is off."""
    runs: list[Run] = []
    radius = float(machine["radius"])
    circles = [(feed, sense, way) for feed in feeds for sense, way in _WAYS]
    for repeat in range(1, _REPEATS + 1):
        for i in rng.permutation(len(circles)):
            feed, sense, way = circles[i]
            share = (np.arange(_SAMPLES) + rng.random()) / _SAMPLES
            angle_deg = 360.0 * (share if sense > 0 else 1.0 - share)
            angle = np.radians(angle_deg)
            bar_um = 1e3 * radius + _error_um(machine, feed, sense, angle, law)
            x = bar_um * np.cos(angle) + _CENTRE_UM[0]
            y = bar_um * np.sin(angle) + _CENTRE_UM[1]
            noise = noise_um * rng.standard_normal(_SAMPLES)
            meta = RunMeta(
                f"r{len(runs)}", plane="XY", direction=way, radius_mm=radius, feed_mm_min=feed, repeat=repeat
            )
            samples = {
                "t_s": 2.0 * np.pi * radius / (feed / 60.0) * np.arange(_SAMPLES) / _SAMPLES,
                "angle_deg": angle_deg,
                "deviation_um": np.hypot(x, y) - 1e3 * radius + noise,
            }
            runs.append(Run(meta, samples))
    return runs
