"""What sister machines are worth: sizes of faults from a short test alone, and with what ten sisters say.

Fleets of virtual mills, which share no formula with the fit, are tested by two repeats on one circle, both ways, at 0.5 or 5 µm of noise.
Their lost motion, squareness and scale are drawn: alike (0.3 µm, 3 µrad and 3 µm/m between machines), unlike (ten times that),
or alike but for one machine with lost motion of 8 µm more. Truth is what the same fit tells of the same machine by
eight repeats at 0.05 µm. Shown are the RMS errors over all machines and sizes, how often the stated
k = 2 holds the truth, and which machines are said to differ.

Run: OMP_NUM_THREADS=1 python benchmarks/sister_machines.py [--fleets N] [--short] [--json]
"""

from __future__ import annotations

import argparse
import json
from typing import Any

import numpy as np

from dtwin.fleet.sisters import _compared
from dtwin.machines.mill import VirtualMill
from dtwin.machines.mill_parameters import AxisParameters, CircularTest, MillParameters, NoiseParameters
from dtwin.physics.fit import fit
from dtwin.physics.library import Library
from dtwin.physics.observations import observe
from dtwin.physics.twin import chosen_terms
from dtwin.report.text import table
from dtwin.schema import Floats

MACHINES, ODD_UM = 11, 8.0
EFFECTS = ("backlash:X", "squareness:XY", "scale_mismatch:XY")
BETWEEN = np.array([0.3, 3.0, 3.0])
STORIES = {
    f"{name}, {noise_um:g} µm": (spread, odd, noise_um)
    for noise_um in (0.5, 5.0)
    for name, spread, odd in (("alike", 1.0, 0), ("unlike", 10.0, 0), ("alike but one", 1.0, 1))
}


def estimates(mill: MillParameters, seed: int, repeats: int, noise_um: float) -> tuple[Floats, Floats]:
    """Return sizes and standard uncertainties, shape (3,) each."""
    made = VirtualMill(mill, seed=seed, noise=NoiseParameters(rms_um=noise_um))
    tests = [CircularTest("XY", way, 100.0, 1500.0, k, "xy") for k in range(1, repeats + 1) for way in ("CCW", "CW")]
    obs = observe(made.campaign(), made.measure(tests))
    found = fit(obs, chosen_terms(EFFECTS, Library(), obs)).estimates
    return np.array([e.value for e in found]), np.array([e.uncertainty for e in found]) / 2.0


def story(spread: float, odd: int, noise_um: float, fleets: int) -> dict[str, Any]:
    """Return the figures of one sort of fleet."""
    alone, with_sisters, covered_alone, covered = [], [], [], []
    named, false = 0, 0
    for number in range(fleets):
        rng = np.random.default_rng([number, int(spread), odd])
        drawn = np.array([5.0, 20.0, 15.0]) + spread * BETWEEN * rng.standard_normal((MACHINES, 3))
        drawn[:odd, 0] += ODD_UM
        truth, values, errors = (np.empty((MACHINES, 3)) for _ in range(3))
        for i, (play, lean, ppm) in enumerate(drawn):
            x = AxisParameters(play_um=float(abs(play)), scale_ppm=float(ppm))
            mill = MillParameters(x=x, squareness_um_m={"XY": float(lean)})
            truth[i], _ = estimates(mill, 1000 + i, 8, 0.05)
            values[i], errors[i] = estimates(mill, 100 * number + i, 2, noise_um)
        for k in range(3):
            found = _compared(values[:, k], errors[:, k], 3 * MACHINES)
            scale = errors[:, k].mean()
            alone += list((values[:, k] - truth[:, k]) / scale)
            with_sisters += list((found.values - truth[:, k]) / scale)
            covered_alone += list(abs(values[:, k] - truth[:, k]) <= 2.0 * errors[:, k])
            covered += list(abs(found.values - truth[:, k]) <= 2.0 * found.errors)
            mine = np.arange(MACHINES) < (odd if k == 0 else 0)
            named += int(np.sum(found.differs & mine))
            false += int(np.sum(found.differs & ~mine))
    return {
        "machines": fleets * MACHINES,
        "error_ratio": float(np.sqrt(np.mean(np.square(with_sisters)) / np.mean(np.square(alone)))),
        "covered_alone": float(np.mean(covered_alone)),
        "covered_with_sisters": float(np.mean(covered)),
        "odd_named": named,
        "odd": fleets * odd,
        "false": false,
        "tests": 3 * fleets * MACHINES,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fleets", type=int, default=6)
    parser.add_argument("--short", action="store_true", help="one fleet of each sort")
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    rows = {name: story(*made, 1 if asked.short else asked.fleets) for name, made in STORIES.items()}
    if asked.json:
        print(json.dumps(rows))
        return
    head = (
        "machines are",
        "error with sisters / alone",
        "k = 2 holds: alone",
        "with sisters",
        "odd ones named",
        "false",
    )
    shown = [
        [
            name,
            f"{r['error_ratio']:.2f}",
            f"{r['covered_alone']:.3f}",
            f"{r['covered_with_sisters']:.3f}",
            f"{r['odd_named']}/{r['odd']}",
            f"{r['false']}/{r['tests']}",
        ]
        for name, r in rows.items()
    ]
    print(table(head, shown))


if __name__ == "__main__":
    main()
