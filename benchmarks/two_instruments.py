"""A machine with a ball bar and a laser: is an ambiguity of one test resolved by the other, and rightly?

Circles of the virtual mill (one radius, one feed, both ways, three repeats, noise 0.1 um), which are no formulas of the library;
positions by formulas of their own (``tests/laser_axis.py``: five runs, noise 0.15 um, datum 0.3 um). Stories are pairs that
circles at one feed cannot tell apart: a scale of X, or an X that gives way in a mode; lost motion of X, friction of its drive,
or both. Sizes and signs are drawn anew in each case.

Run: python benchmarks/two_instruments.py [--cases N] [--short] [--json]
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from laser_axis import readings

from dtwin.machines.mill import VirtualMill
from dtwin.machines.mill_noise import NoiseParameters
from dtwin.machines.mill_parameters import CircularTest, MillParameters
from dtwin.physics.diagnose import diagnose
from dtwin.physics.joint import MachineTest, joint
from dtwin.physics.library import Library
from dtwin.physics.observations import Observations, observe
from dtwin.report.text import table
from dtwin.schema import Campaign, Run, RunMeta

LIBRARY = Library()
DAY = "2026-01-01"
MODES = {"inertial_compliance", "servo_lag", "structural_resonance X", "structural_resonance Y"}
# What is drawn: faults of X in the mill, lead in ppm and lost motion in um that the laser reads on X, and the right names.
Drawn = tuple[dict[str, float], float, float, set[str]]


def _signed(rng: np.random.Generator, low: float, high: float) -> float:
    return float(rng.choice([-1.0, 1.0]) * rng.uniform(low, high))


def _scale(rng: np.random.Generator) -> Drawn:
    ppm = _signed(rng, 5.0, 40.0)
    return {"scale_ppm": ppm}, ppm, 0.0, {"scale_mismatch XY"}


def _mode(rng: np.random.Generator) -> Drawn:
    return {"mode_share": rng.uniform(0.2, 0.8), "mode_hz": rng.uniform(18.0, 35.0)}, 0.0, 0.0, MODES


def _lost_motion(rng: np.random.Generator) -> Drawn:
    um = rng.uniform(1.0, 6.0)
    return {"play_um": um}, 0.0, um, {"backlash X"}


def _friction(rng: np.random.Generator) -> Drawn:
    return {"friction_mm_s2": rng.uniform(30.0, 300.0)}, 0.0, 0.0, {"friction X"}


def _both(rng: np.random.Generator) -> Drawn:
    um = rng.uniform(1.0, 6.0)
    return {"friction_mm_s2": rng.uniform(30.0, 300.0), "play_um": um}, 0.0, um, {"friction X", "backlash X"}


STORIES: dict[str, Callable[[np.random.Generator], Drawn]] = {
    "a scale of X": _scale,
    "X gives way in a mode": _mode,
    "lost motion of X": _lost_motion,
    "friction of X": _friction,
    "friction and lost motion of X": _both,
}


def _judged(name: str, obs: Observations) -> MachineTest:
    return MachineTest(name, DAY, obs, diagnose(obs, [], LIBRARY))


def _circles(faults: dict[str, float], seed: int) -> MachineTest:
    mill = VirtualMill(MillParameters().with_axis("X", **faults), seed=seed, noise=NoiseParameters(rms_um=0.1))
    tests = [CircularTest("XY", way, 100.0, 2000.0, k, "xy") for k in (1, 2, 3) for way in ("CCW", "CW")]
    return _judged("bar", observe(mill.campaign(), mill.measure(tests)))


def _laser(axis: str, lead_ppm: float, lost_um: float, seed: int) -> MachineTest:
    runs = []
    for number, (at, ways, error) in enumerate(readings(lead_ppm, lost_um, seed), start=1):
        samples = {"position_mm": at, "direction": np.array(ways, dtype=object), "error_um": error}
        meta = RunMeta(f"r{number}", kind="linear", condition={"axis": axis}, repeat=number)
        runs.append(Run(meta, {"t_s": 10.0 * np.arange(at.size), **samples}))
    return _judged(f"laser-{axis}", observe(Campaign(f"laser-{axis}", "mill", kind="linear"), runs))


def told(story: str, case: int) -> dict[str, Any]:
    """Return what the ball bar says alone and with the laser, and how the size that they agree on compares."""
    rng = np.random.default_rng([case, list(STORIES).index(story)])
    faults, lead_ppm, lost_um, right = STORIES[story](rng)
    bar = _circles(faults, case)
    found = joint([bar, _laser("X", lead_ppm, lost_um, 2 * case), _laser("Y", 0.0, 0.0, 2 * case + 1)], LIBRARY)
    groups = [{s.label for s in group} for group in bar.found.found]
    group = next((g for g in groups if g & right), set())
    settled = next((s for s in found.settled if set(s.group) & right), None)
    parts = {j.label for s in found.settled for j in s.judged if j.said == "is a part"}
    left = group if settled is None else set(settled.left)
    truth = {"scale": lead_ppm, "backlash": lost_um}
    sizes = [s for s in found.shared if s.cause in truth and s.axis in ("X", "XY")]
    return {
        "seen": bool(group),
        "ambiguous": len(group) > 1,
        "named": bool(left & right) and left | parts <= right,
        "wrong": bool(left) and not left & right,
        "covered": [bool(abs(s.value - truth[s.cause]) <= s.uncertainty) for s in sizes if not s.apart],
        "contradicted": any(s.apart for s in sizes),
    }


def row(story: str, cases: int) -> dict[str, Any]:
    """Return how often one story is ambiguous alone, and named with both."""
    found = [told(story, case) for case in range(cases)]
    unclear = [f for f in found if f["ambiguous"]]
    covered = [c for f in found for c in f["covered"]]
    return {
        "story": story,
        "machines": cases,
        "seen by the ball bar": sum(f["seen"] for f in found),
        "ambiguous alone": len(unclear),
        "of these named with both": sum(f["named"] for f in unclear),
        "wrong with both": sum(f["wrong"] for f in found),
        "called a contradiction": sum(f["contradicted"] for f in found),
        "size covered (k = 2)": f"{sum(covered)} of {len(covered)}",
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=100)
    parser.add_argument("--short", action="store_true")
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    rows = [row(story, 3 if asked.short else asked.cases) for story in STORIES]
    if asked.json:
        print(json.dumps(rows))
        return
    print(table(list(rows[0]), [list(r.values()) for r in rows]))


if __name__ == "__main__":
    main()
