"""A machine with a ball bar and lasers: is an ambiguity of one test resolved by one twin of all, and rightly?

Circles of the virtual mill (one radius, one feed, both ways, three repeats, noise 0.1 um), which are no formulas of the library;
positions by formulas of their own (``tests/laser_axis.py``: five runs, noise 0.15 um, datum 0.3 um). Stories are what
circles at one feed cannot tell: a scale of X, or an X that gives way in a mode; X and Y scaled alike, or a longer bar; lost
motion of X, friction of its drive, or both; or nothing at all. Sizes and signs are drawn anew in each case.

Each test is diagnosed by itself, and all of them in one twin, from nothing until nothing more is found. A name is false that
stands alone and is not what was drawn; the unit is the machine.

Run: python benchmarks/two_instruments.py [--cases N] [--short] [--json]
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from mill_and_laser import circles, laser

from dtwin.machines.mill_parameters import MillParameters
from dtwin.physics.contradictions import without_contradictions
from dtwin.physics.diagnose import diagnose
from dtwin.physics.fit import fit
from dtwin.physics.library import Library
from dtwin.physics.machine_terms import key_of, machine_terms
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Term
from dtwin.physics.several import fit_several
from dtwin.physics.several_diagnosis import diagnose_several
from dtwin.physics.several_twin import SeveralTwin, several_twin_of
from dtwin.physics.twin import chosen_terms
from dtwin.report.text import table

LIBRARY = Library()
MOST_ROUNDS = 4
MODES = {"inertial_compliance", "servo_lag", "structural_resonance X", "structural_resonance Y"}
SCALES = {
    axis: {f"lead_error {axis}", f"scale_mismatch {axis}", "scale_mismatch XY", "scale_mismatch"} for axis in ("X", "Y")
}
Groups = list[set[str]]
# Faults of X and of Y in the mill; leads in ppm and lost motion of X in um that lasers read; names, one set for each cause.
Drawn = tuple[dict[str, float], dict[str, float], float, float, float, list[set[str]]]


def _signed(rng: np.random.Generator, low: float, high: float) -> float:
    return float(rng.choice([-1.0, 1.0]) * rng.uniform(low, high))


def _scale(rng: np.random.Generator) -> Drawn:
    ppm = _signed(rng, 5.0, 40.0)
    return {"scale_ppm": ppm}, {}, ppm, 0.0, 0.0, [SCALES["X"]]


def _alike(rng: np.random.Generator) -> Drawn:
    ppm = _signed(rng, 5.0, 40.0)
    return {"scale_ppm": ppm}, {"scale_ppm": ppm}, ppm, ppm, 0.0, [SCALES["X"], SCALES["Y"]]


def _mode(rng: np.random.Generator) -> Drawn:
    faults = {"mode_share": rng.uniform(0.2, 0.8), "mode_hz": rng.uniform(18.0, 35.0)}
    return faults, {}, 0.0, 0.0, 0.0, [MODES]


def _lost_motion(rng: np.random.Generator) -> Drawn:
    um = rng.uniform(1.0, 6.0)
    return {"play_um": um}, {}, 0.0, 0.0, um, [{"backlash X"}]


def _friction(rng: np.random.Generator) -> Drawn:
    return {"friction_mm_s2": rng.uniform(30.0, 300.0)}, {}, 0.0, 0.0, 0.0, [{"friction X"}]


def _both(rng: np.random.Generator) -> Drawn:
    um = rng.uniform(1.0, 6.0)
    faults = {"friction_mm_s2": rng.uniform(30.0, 300.0), "play_um": um}
    return faults, {}, 0.0, 0.0, um, [{"friction X"}, {"backlash X"}]


def _nothing(rng: np.random.Generator) -> Drawn:
    return {}, {}, 0.0, 0.0, 0.0, []


STORIES: dict[str, Callable[[np.random.Generator], Drawn]] = {
    "a scale of X": _scale,
    "X and Y scaled alike": _alike,
    "X gives way in a mode": _mode,
    "lost motion of X": _lost_motion,
    "friction of X": _friction,
    "friction and lost motion of X": _both,
    "nothing": _nothing,
}


def _twin(campaigns: Sequence[Observations], terms: Sequence[Term]) -> SeveralTwin:
    fitted, apart = without_contradictions(fit_several(campaigns, terms, LIBRARY), [""] * len(campaigns))
    about: list[dict[str, Any]] = [{} for _ in campaigns]
    return several_twin_of(fitted, apart, campaigns, name="all", version=1, action="fit", data=about)


def discovered(campaigns: Sequence[Observations]) -> tuple[SeveralTwin, Groups]:
    """Return the twin with all that was found, and each name with what could not be told from it."""
    twin, groups = _twin(campaigns, []), Groups()
    for _ in range(MOST_ROUNDS):
        found = diagnose_several(twin, campaigns, LIBRARY).found
        terms = {key_of(term): term for term in twin.terms}
        for group in found:
            for term in machine_terms([group[0].effect], LIBRARY, campaigns, group[0].axis):
                terms.setdefault(key_of(term), term)
        if len(terms) == len(twin.terms):
            break
        groups += [{s.label for s in group} for group in found]
        twin = _twin(campaigns, list(terms.values()))
    return twin, groups


def _alone(obs: Observations) -> Groups:
    """Return the same of one campaign by itself."""
    terms, groups = list[Term](), Groups()
    for _ in range(MOST_ROUNDS):
        found = diagnose(obs, terms, LIBRARY).found
        if not found:
            break
        names = [f"{group[0].effect}:{group[0].axis}" for group in found]
        groups += [{s.label for s in group} for group in found]
        terms = list(fit(obs, [*terms, *chosen_terms(names, LIBRARY, obs)]).terms)
    return groups


def _named(groups: Groups, right: list[set[str]]) -> bool:
    """Tell whether every cause has a group of nothing but right names."""
    return all(any(group <= names for group in groups) for names in right)


def _false(groups: Groups, right: list[set[str]]) -> bool:
    every = set().union(*right)
    return any(len(group) == 1 and not group <= every for group in groups)


def told(story: str, case: int) -> dict[str, Any]:
    """Return what tests say alone and in one twin, and how the sizes that they share compare."""
    rng = np.random.default_rng([case, list(STORIES).index(story)])
    of_x, of_y, lead_x, lead_y, lost_um, right = STORIES[story](rng)
    mill = MillParameters().with_axis("X", **of_x).with_axis("Y", **of_y)
    campaigns = [circles(mill, case), laser("X", lead_x, lost_um, 2 * case), laser("Y", lead_y, 0.0, 2 * case + 1)]
    alone = [_alone(obs) for obs in campaigns]
    twin, groups = discovered(campaigns)
    truth = {("scale", "X"): lead_x, ("scale", "Y"): lead_y, ("backlash", "X"): lost_um}
    contradicted = {c.effect for c in twin.contradictions}
    sizes = [
        (truth[key_of(term)], next(e for e in twin.estimates if (e.effect, e.axis) == _where(term)))
        for term in twin.terms
        if key_of(term) in truth and term.instance.effect.name not in contradicted
    ]
    shown = all(any(group & names for one in alone for group in one) for names in right)
    return {
        "shown": shown,
        "unclear": shown and not _named(alone[0], right),
        "named": _named(groups, right),
        "false alone": any(_false(one, right) for one in alone),
        "false": _false(groups, right),
        "contradicted": bool(contradicted),
        "covered": [bool(abs(e.value - true) <= e.uncertainty) for true, e in sizes],
        "groups": [sorted(group) for group in groups],
    }


def _where(term: Term) -> tuple[str, str]:
    return term.instance.effect.name, term.instance.axis


def row(story: str, cases: int) -> dict[str, Any]:
    """Return how often one story is not told by the ball bar alone, and is named in one twin."""
    found = [told(story, case) for case in range(cases)]
    unclear, shown = [f for f in found if f["unclear"]], [f for f in found if f["shown"]]
    covered = [c for f in found for c in f["covered"]]
    return {
        "story": story,
        "machines": cases,
        "shown by some test": len(shown),
        "of these named in one twin": sum(f["named"] for f in shown),
        "not told by the ball bar": len(unclear),
        "of these named with both": sum(f["named"] for f in unclear),
        "a false name by one test": sum(f["false alone"] for f in found),
        "a false name in one twin": sum(f["false"] for f in found),
        "a contradiction": sum(f["contradicted"] for f in found),
        "sizes covered (k = 2)": f"{sum(covered)} of {len(covered)}",
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=100)
    parser.add_argument("--short", action="store_true")
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    rows = [row(story, 1 if asked.short else asked.cases) for story in STORIES]
    if asked.json:
        print(json.dumps(rows))
        return
    print(table(list(rows[0]), [list(r.values()) for r in rows]))


if __name__ == "__main__":
    main()
