"""A machine with a ball bar and lasers: is an ambiguity of one test resolved by one twin of all, and rightly?

Circles of the virtual mill (one radius, one feed, both ways, three repeats or ``--repeats``, noise 0.1 um), which are no formulas of the library;
positions by formulas of their own (``tests/laser_axis.py``: five runs, noise 0.15 um, datum 0.3 um). Stories are what
circles at one feed cannot tell: a scale of X, or an X that gives way in a mode; X and Y scaled alike, or a longer bar; lost
motion of X, friction of its drive, or both; or nothing at all. Further: a long wave of the screw of X, which a laser reads, against three lobes
of the bar, which a second radius tells; growth of X and Y with temperature against drift of the bar's length, which lasers tell that are
repeated from 19 to 21 degrees; the same two with circles of three radii as well; and no laser, but two tests by the ball bar, each at one
feed or radius, of a scale, a mode and lobes. Sizes and signs are drawn anew in each case.

Each test is diagnosed by itself, and all of them in one twin, from nothing until nothing more is found. A name is false that
stands alone and is not what was drawn; the unit is the machine.

Run: python benchmarks/two_instruments.py [--cases N] [--short] [--json]
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from mill_and_laser import circles, circular_tests, laser, warmed

from dtwin.machines.mill import SetupErrors, VirtualMill
from dtwin.machines.mill_parameters import MillParameters, NoiseParameters
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


# Tests of one instrument, tests of all, and names, one set for each cause.
Tests = tuple[list[Observations], list[Observations], list[set[str]]]
# What the ball bar reads of a mill.
Bar = Callable[..., Observations]
NOISE_UM = 0.1


def visible_um(mill: MillParameters, radii_mm: Sequence[float] = (100.0,)) -> float:
    """Return the RMS of what a mill changes in the readings, centre and radius of each set-up taken out, without noise."""
    changed = []
    for one in (mill, MillParameters()):
        still = VirtualMill(
            one,
            noise=NoiseParameters(rms_um=0.0),
            setup_errors=SetupErrors(0.0, 0.0, jitter_us=0.0, trigger_samples=0.0),
        )
        changed.append(still.measure(circular_tests(radii_mm)))
    left = []
    for setup in {run.meta.setup for run in changed[0]}:
        pairs = [(a, b) for a, b in zip(*changed, strict=True) if a.meta.setup == setup]
        angle = np.radians(np.concatenate([a.samples["angle_deg"] for a, _ in pairs]))
        um = np.concatenate([a.samples["deviation_um"] - b.samples["deviation_um"] for a, b in pairs])
        basis = np.stack([np.ones_like(angle), np.cos(angle), np.sin(angle)], axis=1)
        left.append(um - basis @ np.linalg.lstsq(basis, um, rcond=None)[0])
    return float(np.sqrt(np.mean(np.concatenate(left) ** 2)))


def _sized(k: float, usual: float, mill_of: Callable[[float], MillParameters]) -> float:
    """Return the size of a cause whose mark on the circles of one radius is ``k`` times the noise; the usual one for 0."""
    return usual if k == 0.0 else k * NOISE_UM / visible_um(mill_of(1.0))


def _signed(rng: np.random.Generator, low: float, high: float) -> float:
    return float(rng.choice([-1.0, 1.0]) * rng.uniform(low, high))


def _of_axes(axes: str, **faults: float) -> MillParameters:
    made = MillParameters()
    for axis in axes:
        made = made.with_axis(axis, **faults)
    return made


def _scaled(rng: np.random.Generator, k: float, axes: str) -> float:
    usual = _signed(rng, 5.0, 40.0)
    return float(np.sign(usual)) * _sized(k, abs(usual), lambda ppm: _of_axes(axes, scale_ppm=ppm))


def _scale(rng: np.random.Generator, k: float) -> Drawn:
    ppm = _scaled(rng, k, "X")
    return {"scale_ppm": ppm}, {}, ppm, 0.0, 0.0, [SCALES["X"]]


def _alike(rng: np.random.Generator, k: float) -> Drawn:
    # A scale of both is a longer bar, and shows on no circle: its size is that of one.
    ppm = _scaled(rng, k, "X")
    return {"scale_ppm": ppm}, {"scale_ppm": ppm}, ppm, ppm, 0.0, [SCALES["X"], SCALES["Y"]]


def _mode(rng: np.random.Generator, k: float) -> Drawn:
    share, hz = rng.uniform(0.2, 0.8), rng.uniform(18.0, 35.0)
    share = _sized(k, share, lambda size: _of_axes("X", mode_share=size, mode_hz=hz))
    return {"mode_share": share, "mode_hz": hz}, {}, 0.0, 0.0, 0.0, [MODES]


def _lost(rng: np.random.Generator, k: float) -> float:
    return _sized(k, rng.uniform(1.0, 6.0), lambda um: _of_axes("X", play_um=um))


def _rubs(rng: np.random.Generator, k: float) -> float:
    return _sized(k, rng.uniform(30.0, 300.0), lambda mm_s2: _of_axes("X", friction_mm_s2=mm_s2))


def _lost_motion(rng: np.random.Generator, k: float) -> Drawn:
    um = _lost(rng, k)
    return {"play_um": um}, {}, 0.0, 0.0, um, [{"backlash X"}]


def _friction(rng: np.random.Generator, k: float) -> Drawn:
    return {"friction_mm_s2": _rubs(rng, k)}, {}, 0.0, 0.0, 0.0, [{"friction X"}]


def _both(rng: np.random.Generator, k: float) -> Drawn:
    um = _lost(rng, k)
    return {"friction_mm_s2": _rubs(rng, k), "play_um": um}, {}, 0.0, 0.0, um, [{"friction X"}, {"backlash X"}]


def _nothing(rng: np.random.Generator, k: float) -> Drawn:
    return {}, {}, 0.0, 0.0, 0.0, []


def _long_wave(rng: np.random.Generator, case: int, k: float, bar: Bar) -> Tests:
    um, pitch_mm, phase_rad = rng.uniform(0.5, 2.0), rng.uniform(150.0, 250.0), rng.uniform(0.0, 6.28)

    def mill(size: float) -> MillParameters:
        return MillParameters().with_axis("X", pitch_error_um=size, pitch_mm=pitch_mm, pitch_phase_rad=phase_rad)

    um = _sized(k, um, mill)
    tests = [bar(mill(um)), warmed("X", case, wave=(um, pitch_mm, phase_rad)), warmed("Y", case)]
    return tests[:1], tests, [{"cyclic_error X", "pitch_error X"}]


FEW_RADII_MM, ALL_RADII_MM = (50.0, 100.0), (50.0, 100.0, 150.0)


def _lobes(rng: np.random.Generator, case: int, k: float, bar: Bar, radii_mm: Sequence[float] = FEW_RADII_MM) -> Tests:
    um, phase_rad = rng.uniform(0.5, 2.0), rng.uniform(0.0, 6.28)

    def mill(size: float) -> MillParameters:
        return MillParameters(cup_lobe_um=size, cup_phase_rad=phase_rad)

    made = mill(_sized(k, um, mill))
    return [bar(made)], [bar(made, radii_mm=radii_mm)], [{"instrument_artefact"}]


def _growth(rng: np.random.Generator, case: int, k: float, bar: Bar) -> Tests:
    def mill(size: float) -> MillParameters:
        return MillParameters().with_axis("X", growth_um_m_k=size).with_axis("Y", growth_um_m_k=size)

    um_m_k = _sized(k, rng.uniform(5.0, 15.0), mill)
    tests = [bar(mill(um_m_k)), *(warmed(axis, case, growth_um_m_k=um_m_k) for axis in "XY")]
    return tests[:1], tests, [{"thermal_growth", "thermal_growth X", "thermal_growth Y"}]


def _drift(rng: np.random.Generator, case: int, k: float, bar: Bar, radii_mm: Sequence[float] = (100.0,)) -> Tests:
    def mill(size: float) -> MillParameters:
        return MillParameters(bar_growth_um_h=size)

    um_h = _signed(rng, 5.0, 20.0)
    um_h = float(np.sign(um_h)) * _sized(k, abs(um_h), mill)
    tests = [bar(mill(um_h), radii_mm=radii_mm), *(warmed(axis, case) for axis in "XY")]
    return [bar(mill(um_h))], tests, [{"thermal_drift", "thermal_shift"}]


def _on_two_days(mill: MillParameters, case: int, bar: Bar, names: list[set[str]], **swept: Sequence[float]) -> Tests:
    """Return two tests by the ball bar, each at one value of what is swept."""
    ((what, values),) = swept.items()
    tests = [bar(mill, seed=2 * case + n, name=f"bar-{n}", **{what: (value,)}) for n, value in enumerate(values)]
    return tests[:1], tests, names


def _scale_by_feeds(rng: np.random.Generator, case: int, k: float, bar: Bar) -> Tests:
    mill = _of_axes("X", scale_ppm=_scaled(rng, k, "X"))
    return _on_two_days(mill, case, bar, [SCALES["X"]], feeds_mm_min=(1000.0, 4000.0))


def _mode_by_feeds(rng: np.random.Generator, case: int, k: float, bar: Bar) -> Tests:
    return _on_two_days(_of_axes("X", **_mode(rng, k)[0]), case, bar, [MODES], feeds_mm_min=(2000.0, 4000.0))


def _lobes_by_radii(rng: np.random.Generator, case: int, k: float, bar: Bar) -> Tests:
    um, phase_rad = rng.uniform(0.5, 2.0), rng.uniform(0.0, 6.28)
    um = _sized(k, um, lambda size: MillParameters(cup_lobe_um=size, cup_phase_rad=phase_rad))
    mill = MillParameters(cup_lobe_um=um, cup_phase_rad=phase_rad)
    return _on_two_days(mill, case, bar, [{"instrument_artefact"}], radii_mm=(50.0, 150.0))


FURTHER: dict[str, Callable[..., Tests]] = {
    "a long wave of X": _long_wave,
    "three lobes of the bar": _lobes,
    "growth with temperature": _growth,
    "drift of the bar": _drift,
    "three lobes of the bar, three radii": partial(_lobes, radii_mm=ALL_RADII_MM),
    "drift of the bar, three radii": partial(_drift, radii_mm=ALL_RADII_MM),
    "a scale of X by bars at two feeds": _scale_by_feeds,
    "a mode of X by bars at two feeds": _mode_by_feeds,
    "three lobes by bars of two radii": _lobes_by_radii,
}
STORIES: dict[str, Callable[[np.random.Generator, float], Drawn]] = {
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


def further(story: str, case: int, k: float, bar: Bar) -> dict[str, Any]:
    """Return the same of a story whose tests are its own, ``k`` times the noise where that is not 0."""
    rng = np.random.default_rng([case, len(STORIES) + list(FURTHER).index(story.partition(",")[0])])
    few, every, right = FURTHER[story](rng, case, k, bar)
    alone = [_alone(obs) for obs in [*few, *every]]
    groups = discovered(every)[1] if len(every) > 1 else alone[-1]
    shown = all(any(group & names for one in alone for group in one) for names in right)
    return {
        "shown": shown,
        "unclear": shown and not _named(alone[0], right),
        "named": _named(groups, right),
        "false alone": any(_false(one, right) for one in alone),
        "false": _false(groups, right),
        "contradicted": False,
        "covered": [],
        "groups": [sorted(group) for group in groups],
    }


def told(story: str, case: int, k: float, bar: Bar) -> dict[str, Any]:
    """Return what tests say alone and in one twin, and how the sizes that they share compare."""
    rng = np.random.default_rng([case, list(STORIES).index(story)])
    of_x, of_y, lead_x, lead_y, lost_um, right = STORIES[story](rng, k)
    mill = MillParameters().with_axis("X", **of_x).with_axis("Y", **of_y)
    campaigns = [bar(mill), laser("X", lead_x, lost_um, 2 * case), laser("Y", lead_y, 0.0, 2 * case + 1)]
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


def row(story: str, cases: range, k: float = 0.0, repeats: int = 3) -> dict[str, Any]:
    """Return how often one story is not told by the ball bar alone, and is named in one twin."""
    one = further if story in FURTHER else told
    found = [one(story, case, k, partial(circles, seed=case, repeats=repeats)) for case in cases]
    unclear, shown = [f for f in found if f["unclear"]], [f for f in found if f["shown"]]
    covered = [c for f in found for c in f["covered"]]
    return {
        "story": story,
        "machines": len(cases),
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
    parser.add_argument("--first", type=int, default=0, help="seed of the first machine")
    parser.add_argument("--k", type=float, default=0.0, help="size of each cause on the circles, in RMS of the noise")
    parser.add_argument("--repeats", type=int, default=3, help="of each circle")
    parser.add_argument("--only", default="", help="stories that have this in their name")
    asked = parser.parse_args()
    stories = [story for story in (*STORIES, *FURTHER) if asked.only in story]
    cases = range(asked.first, asked.first + (1 if asked.short else asked.cases))
    rows = [row(story, cases, asked.k, asked.repeats) for story in stories]
    if asked.json:
        print(json.dumps(rows))
        return
    print(table(list(rows[0]), [list(r.values()) for r in rows]))


if __name__ == "__main__":
    main()
