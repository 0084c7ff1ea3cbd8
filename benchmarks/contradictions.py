"""How often tests of a machine that did not change are said to contradict each other, and how often a change is found.

Machines are drawn by the stories of ``two_instruments.py``, on seeds of their own. Each is measured four times: a ball bar, a laser on X,
one on Y, and the ball bar again two months later. One twin with the effects that are there is fitted to all of them. Nothing
changed, so every contradiction is false; by Holm over campaigns and parameters one machine in a hundred should have one. Then the
same with ``--step-um`` of lost motion in X more on the last day: a change, said to be since that day; of backlash, alone or beside what
the tests cannot tell from it.

Unit of replication: the machine, with all its tests.

Run: python benchmarks/contradictions.py [--cases N] [--first SEED] [--step-um UM] [--feeds MM_MIN,...] [--short] [--json]
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from mill_and_laser import circles, laser
from scipy.stats import binomtest
from two_instruments import LIBRARY, STORIES

from dtwin.machines.mill_parameters import MillParameters
from dtwin.physics.contradictions import Contradiction, without_contradictions
from dtwin.physics.machine_terms import machine_terms
from dtwin.physics.several import fit_several
from dtwin.physics.several_twin import started_of
from dtwin.report.text import table

# What the twin of a story has: the effects that are there.
EFFECTS: Mapping[str, tuple[str, ...]] = {
    "a scale of X": ("lead_error:X",),
    "X and Y scaled alike": ("lead_error:X", "lead_error:Y"),
    "X gives way in a mode": ("structural_resonance:X",),
    "lost motion of X": ("backlash:X",),
    "friction of X": ("friction:X",),
    "friction and lost motion of X": ("friction:X", "backlash:X"),
    "nothing": ("lead_error:X", "lead_error:Y", "backlash:X", "squareness"),
}
DAYS = ("2026-01-05", "2026-01-12", "2026-01-13", "2026-03-09")


def apart(
    story: str, case: int, step_um: float, feeds_mm_min: Sequence[float] = (2000.0,)
) -> tuple[Contradiction, ...]:
    """Return what contradicts what on one machine, with more lost motion of X on the last day."""
    rng = np.random.default_rng([case, list(STORIES).index(story)])
    of_x, of_y, lead_x, lead_y, lost_um, _ = STORIES[story](rng, 0.0)
    mill = MillParameters().with_axis("X", **of_x).with_axis("Y", **of_y)
    later = mill.with_axis("X", play_um=lost_um + step_um)
    bar, of_laser_x, of_laser_y, again = DAYS
    campaigns = [
        circles(mill, 2 * case, "bar", bar, feeds_mm_min=feeds_mm_min),
        laser("X", lead_x, lost_um, 2 * case, day=of_laser_x),
        laser("Y", lead_y, 0.0, 2 * case + 1, day=of_laser_y),
        circles(later, 2 * case + 1, "bar-again", again, feeds_mm_min=feeds_mm_min),
    ]
    names = [*EFFECTS[story], *(["backlash:X"] if step_um and "backlash:X" not in EFFECTS[story] else [])]
    fitted = fit_several(campaigns, machine_terms(names, LIBRARY, campaigns), LIBRARY)
    return without_contradictions(fitted, [started_of(obs) for obs in campaigns])[1]


def row(story: str, cases: range, step_um: float, feeds_mm_min: Sequence[float]) -> dict[str, Any]:
    """Return how often machines of a story contradict themselves, unchanged and changed."""
    false = sum(bool(apart(story, case, 0.0, feeds_mm_min)) for case in cases)
    found = right = by_itself = wrong = 0
    for case in cases:
        every = apart(story, case, step_um, feeds_mm_min)
        told = [c for c in every if "backlash X" in (f"{c.effect} {c.axis}", *c.rivals)]
        found += bool(told)
        right += any(c.since[:10] == DAYS[-1] for c in told)
        by_itself += any(c.effect == "backlash" and not c.rivals for c in told)
        wrong += len(told) < len(every)
    low, high = binomtest(false, len(cases)).proportion_ci()
    return {
        "story": story,
        "machines": len(cases),
        "a false contradiction": false,
        "share of machines, 95 %": f"{100 * low:.1f} to {100 * high:.1f} %",
        "a change found": found,
        "since the right day": right,
        "told by one name": by_itself,
        "something else told": wrong,
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=100)
    parser.add_argument("--first", type=int, default=5000, help="seed of the first machine")
    parser.add_argument("--step-um", type=float, default=1.0)
    parser.add_argument("--feeds", default="2000", help="of the circles, mm/min, separated by commas")
    parser.add_argument("--only", default="", help="stories that have this in their name")
    parser.add_argument("--short", action="store_true", help="the same code with little data")
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    cases = range(asked.first, asked.first + (1 if asked.short else asked.cases))
    feeds = [float(feed) for feed in asked.feeds.split(",")]
    rows = [row(story, cases, asked.step_um, feeds) for story in STORIES if asked.only in story]
    if asked.json:
        print(json.dumps(rows))
        return
    print(table(list(rows[0]), [list(r.values()) for r in rows]))


if __name__ == "__main__":
    main()
