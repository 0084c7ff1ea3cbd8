"""A machine that heat deforms, with channels that deform nothing: are they told as causes, and what of the causes is lost?

Each machine has five bodies that are heated by jobs, by days, by one warm-up or by a wandering hall, one to four thermocouples
on each (noise, lag, some feel a neighbour), and ten error motions of one to three bodies, half of them late as a core is.
Every third is moved by a body without a thermocouple, too. 26 to 120 cycles in 234 h. Beside them two channels wander by
themselves (random walks, some with a lag), and one rises: among the thermocouples, or logged beside them. A cause counts that
moves its motion by more than the noise. Each machine is diagnosed once, from nothing; a motion is told as in `dtwin twin diagnose`.

``fitted``: bodies of the temperatures that fit best, as a choice by fit alone takes them. ``told``: what the diagnosis names.
``sure``: without another body or time alone beside it. Unit of replication: the machine.

``--elsewhere``: what a correction would leave in the next 234 h, which neither choice saw: RMS over motions of machines,
um, by what fits best (``dtwin train``) and by the causes only (``dtwin twin fit``).

Run: python benchmarks/heat_decoys.py [--machines N] [--first SEED] [--elsewhere] [--short] [--json]
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np

from dtwin.kinds.volumetric._heat_diagnosis import diagnose_heat
from dtwin.kinds.volumetric._heat_series import HeatSeries, body_of
from dtwin.kinds.volumetric._thermal_model import fit_thermal
from dtwin.kinds.volumetric.heat_twin import fit_heat
from dtwin.report.text import table
from dtwin.schema import Floats
from dtwin.statistics import rms

MOTIONS = ("EX0", "EY0", "EZ0", "EXX1", "EYY1", "EZZ1", "EXZ1", "EZX2", "EAX2", "EXY1")
BODIES = ("bed", "column", "ram", "table", "head")
DECOYS = ("room", "cabinet", "drain")
NOISE_UM = 0.5
HOURS = 234.0


def late(values: Floats, tau_h: float, step_h: float) -> Floats:
    """Return values through a first-order lag."""
    out = np.array(values, dtype=np.float64)
    for i in range(1, len(out)):
        out[i] = out[i - 1] + (1.0 - np.exp(-step_h / tau_h)) * (values[i] - out[i - 1])
    return out


def heated(law: str, hour: Floats, rng: np.random.Generator) -> Floats:
    """Return the temperature of a body since the begin, in K."""
    step, n = hour[1] - hour[0], len(hour)
    if law == "jobs":
        on = np.zeros(n)
        begin, works = 0, bool(rng.random() < 0.5)
        while begin < n:
            end = begin + max(1, int(rng.exponential(rng.uniform(4.0, 12.0)) / step))
            on[begin:end] = works * rng.uniform(0.5, 1.0)
            begin, works = end, not works
        out = late(on * rng.uniform(6.0, 14.0), rng.uniform(1.0, 8.0), step)
    elif law == "day":
        swing = rng.uniform(1.5, 4.0) * np.sin(2.0 * np.pi * (hour / 24.0 + rng.random()))
        out = swing + late(3.0 * rng.normal(0.0, 1.0, n), rng.uniform(6.0, 30.0), step)
    elif law == "warm-up":
        out = rng.uniform(4.0, 10.0) * (1.0 - np.exp(-hour / rng.uniform(5.0, 60.0)))
    else:
        out = late(np.cumsum(rng.normal(0.0, 0.4 * np.sqrt(step), n)), 5.0, step)
    return np.asarray(out - out[0])


def machine(seed: int, decoys: str, *, campaigns: int = 1) -> tuple[HeatSeries, dict[str, set[str]]]:
    """Return campaigns one after the other, and the bodies that move each motion. ``decoys``: none, among the thermocouples, beside them."""
    rng = np.random.default_rng([seed, 5])
    step = HOURS / int(rng.choice([26, 40, 78, 120]))
    n = round(campaigns * HOURS / step)
    hour = np.arange(n) * step
    laws = rng.choice(["jobs", "day", "warm-up", "hall"], size=len(BODIES), p=[0.5, 0.2, 0.15, 0.15])
    heat = {
        body: heated(law, hour, rng) + 0.3 * heated("day", hour, rng) for body, law in zip(BODIES, laws, strict=True)
    }
    unseen = heated(str(rng.choice(["warm-up", "hall", "day"])), hour, rng)
    read: dict[str, Floats] = {}
    for body in BODIES:
        for number in range(int(rng.integers(1, 5))):
            share = rng.uniform(0.0, 0.25) if number else 0.0
            felt = (1.0 - share) * heat[body] + share * heat[BODIES[int(rng.integers(len(BODIES)))]]
            read[f"{body}_{number + 1:02d}_c"] = late(felt, rng.uniform(0.03, 2.0), step) + rng.normal(0.0, 0.05, n)
    values = rng.normal(0.0, NOISE_UM, (n, len(MOTIONS)))
    causes: dict[str, set[str]] = {}
    for column, motion in enumerate(MOTIONS):
        drawn = rng.choice(BODIES, size=int(rng.integers(1, 4)), replace=False)
        per_k = {str(body): rng.choice([-1.0, 1.0]) * rng.uniform(0.5, 3.0) for body in drawn}
        moved = np.sum([k * heat[body] for body, k in per_k.items()], axis=0)
        moved = moved + (rng.random() < 1 / 3) * rng.choice([-1.0, 1.0]) * rng.uniform(0.5, 2.0) * unseen
        values[:, column] += late(moved, rng.uniform(0.5, 6.0), step) if rng.random() < 0.5 else moved
        causes[motion] = {body for body, k in per_k.items() if np.std(k * heat[body]) > NOISE_UM}
    false: dict[str, Floats] = {}
    for name in DECOYS[:2]:
        walk = np.cumsum(rng.normal(0.0, rng.uniform(0.1, 0.4) * np.sqrt(step), n))
        false[f"{name}_01_c"] = late(walk, float(rng.choice([0.1, 3.0, 10.0])), step) + rng.normal(0.0, 0.05, n)
    rise = rng.choice([-1.0, 1.0]) * rng.uniform(2.0, 6.0) * hour / HOURS
    false[f"{DECOYS[2]}_01_c"] = rise + rng.normal(0.0, 0.05, n)
    every = {name: values - values[0] for name, values in (read if decoys == "none" else {**read, **false}).items()}
    sensors = tuple(every) if decoys == "among the thermocouples" else tuple(read)
    eye = np.tile(np.eye(len(MOTIONS)), (n, 1, 1))
    made = HeatSeries(
        "made", "mill", hour, MOTIONS, values, NOISE_UM**2 * eye, eye, np.full(n, NOISE_UM**2), every, dict.fromkeys(every, 20.0), sensors
    )  # fmt: skip
    return made, causes


def row(decoys: str, seeds: range) -> dict[str, Any]:
    """Return what is told of machines."""
    found: Counter[str] = Counter()
    for seed in seeds:
        made, causes = machine(seed, decoys)
        for mover in diagnose_heat(made, fit_heat(made, ()), ()).movers:
            if not mover.told:
                continue
            true, column = causes[mover.motion], MOTIONS.index(mover.motion)
            fitted = set(made.driven(mover.motion, made.values[:, column], tuple(made.bodies)).alike)
            told = {body_of(sensor) for sensor in mover.sensors}
            sure = {body for body in told if not mover.alike.get(body)}
            beside = {one for others in mover.alike.values() for text in others for one in text.split(" and ")}
            found["motions told"] += 1
            found["fitted with a decoy"] += bool(fitted & set(DECOYS))
            found["told with a decoy"] += bool(told & set(DECOYS))
            found["fitted with another false body"] += bool(fitted - true - set(DECOYS))
            found["told with another false body"] += bool(told - true - set(DECOYS))
            found["causes"] += len(true)
            found["fitted"] += len(true & fitted)
            found["sure"] += len(true & sure)
            found["in a group"] += len(true & ((told | beside | {body_of(one) for one in mover.as_time}) - sure))
            found["nowhere"] += len(true - told - beside - {body_of(one) for one in mover.as_time})
    names = ("motions told", "fitted with a decoy", "told with a decoy")
    names += ("fitted with another false body", "told with another false body")
    names += ("causes", "fitted", "sure", "in a group", "nowhere")
    return {"decoys": decoys, "machines": len(seeds), **{name: found[name] for name in names}}


def elsewhere(decoys: str, seeds: range) -> dict[str, Any]:
    """Return what is left in hours that no choice saw."""
    left: dict[str, list[Floats]] = {"nothing": [], "what fits best": [], "causes": []}
    for seed in seeds:
        both, _ = machine(seed, decoys, campaigns=2)
        n = len(both.hour) // 2
        first = replace(
            both, hour=both.hour[:n], rise_c={name: rise[:n] for name, rise in both.rise_c.items()}, _fits={}
        )
        for column, name in enumerate(MOTIONS):
            motion, rises = both.values[:, column], first.rises(both.thermocouples)
            fitted = fit_thermal(name, motion[:n], rises, both.thermocouples)
            left["nothing"].append(motion[n:])
            for how, model in (("what fits best", fitted), ("causes", first.driven(name, motion[:n]).model)):
                left[how].append(motion[n:] - model.run(both.rises(model.sensors))[n:])
    return {
        "decoys": decoys,
        "machines": len(seeds),
        **{f"left by {how}": round(rms(np.concatenate(of)), 2) for how, of in left.items()},
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--machines", type=int, default=40)
    parser.add_argument("--first", type=int, default=0, help="seed of the first machine")
    parser.add_argument("--elsewhere", action="store_true")
    parser.add_argument("--short", action="store_true")
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    seeds = range(asked.first, asked.first + (1 if asked.short else asked.machines))
    rows = [
        (elsewhere if asked.elsewhere else row)(decoys, seeds)
        for decoys in ("none", "among the thermocouples", "beside them")
    ]
    print(json.dumps(rows) if asked.json else table(list(rows[0]), [list(map(str, r.values())) for r in rows]))


if __name__ == "__main__":
    main()
