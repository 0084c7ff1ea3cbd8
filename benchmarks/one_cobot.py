"""One twin of a cobot's circles and poses: are shared sizes covered, how often is a contradiction false, and is a change found?

Cobots are drawn with zeros of joints 2, 3 and 5 that are off, and links that grow with temperature; screws make their tests, which
share no formula with the fit. Each is measured by a ball bar at one place and by a tracker four days later. Nothing changed, so
that every contradiction is false. A month later the tracker measures it again, with joint 3 turned by ``--step-urad``.

Unit of replication: the cobot, with all its tests.

Run: python benchmarks/one_cobot.py [--cases N] [--first SEED] [--step-urad STEP] [--short] [--json]
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from one_cobot import write_circles, write_poses

from dtwin.acquire.ingest import ingest
from dtwin.config import Home
from dtwin.lake.store import Lake
from dtwin.report.text import table
from dtwin.twins._machine_twins import MachineTwins

EFFECTS = ("joint_zero", "thermal_growth")
GROWTH_UM_M_K, TURNED = 15.0, 3
CHANGED = "2026-04-05"


def cobot(case: int, step_urad: float, folder: Path) -> dict[str, int]:
    """Return what one twin of a cobot says right and wrong."""
    rng = np.random.default_rng(case)
    off_mrad = np.zeros(6)
    off_mrad[[1, 2, 4]] = rng.choice([-1.0, 1.0], 3) * rng.uniform(0.1, 0.8, 3)
    later = off_mrad + 1e-3 * step_urad * (np.arange(1, 7) == TURNED)
    write_circles(folder / "bar", off_mrad, day="2026-03-01", growth_um_m_k=GROWTH_UM_M_K, seed=3 * case)
    write_poses(folder / "tracker", off_mrad, day="2026-03-05", growth_um_m_k=GROWTH_UM_M_K, seed=3 * case + 1)
    write_poses(folder / "again", later, day=CHANGED, growth_um_m_k=GROWTH_UM_M_K, seed=3 * case + 2)
    home = Home(folder / "home")
    for name in ("bar", "tracker", "again"):
        ingest(folder / name, Lake(home.lake))
    twins = MachineTwins(home)
    alike = twins.fitted(["bar", "tracker"], EFFECTS, "alike")
    truth = {("joint_offset", str(j)): 1e3 * off for j, off in enumerate(off_mrad, start=1)}
    truth["thermal_growth", ""] = GROWTH_UM_M_K
    told = [one for one in alike.document["shared"] if one["value"] is not None]
    inside = [abs(one["value"] - truth[one["effect"], one["axis"]]) <= one["uncertainty"] for one in told]
    apart = twins.fitted(["bar", "tracker", "again"], EFFECTS, "changed").contradictions
    turned = [c for c in apart if (c.effect, c.axis, c.since[:10]) == ("joint_offset", str(TURNED), CHANGED)]
    return {
        "cobots": 1,
        "shared sizes": len(told),
        "covered, k = 2": sum(inside),
        "a false contradiction": bool(alike.contradictions),
        "a change found, since the right day": bool(turned),
        "told by one name": any(not c.rivals for c in turned),
        "something else told": len(turned) < len(apart),
    }


def main() -> None:
    """Print the row."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=60)
    parser.add_argument("--first", type=int, default=0, help="seed of the first cobot")
    parser.add_argument("--step-urad", type=float, default=60.0)
    parser.add_argument("--short", action="store_true", help="the same code with little data")
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    row: dict[str, Any] = {}
    for case in range(asked.first, asked.first + (1 if asked.short else asked.cases)):
        with tempfile.TemporaryDirectory() as folder:
            one = cobot(case, asked.step_urad, Path(folder))
        row = {name: row.get(name, 0) + int(value) for name, value in one.items()}
    print(json.dumps(row) if asked.json else table(list(row), [list(row.values())]))


if __name__ == "__main__":
    main()
