"""How a twin of tests of a path becomes a correction: each effect is left out, and must be found again."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from dtwin.config import Home
from dtwin.physics.diagnosis import Diagnosis
from dtwin.physics.fit import fit
from dtwin.physics.machine_terms import key_of
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Term
from dtwin.physics.several_diagnosis import SeveralDiagnosis
from dtwin.physics.several_twin import SeveralTwin
from dtwin.physics.state import AXES_OF
from dtwin.physics.twin import Twin, frozen_residual_um, predict_um
from dtwin.statistics import rms
from dtwin.train.dataset import require_uncorrected
from dtwin.train.twin_terms import TwinBundle
from dtwin.twins.correct import NOT_NEEDED, ByOthers, Case, Grading, Judged
from dtwin.twins.of_kind import AnyTwins
from dtwin.twins.seen import Seen, seen_on
from dtwin.units import shown_number

BY_LAW = ("law-confirmed", "intervention-confirmed")
# Served inside of what was measured only, nothing is carried on by a law: the shape must hold there.
BY_SHAPE = ("shape-consistent", *BY_LAW)
_NAMED = ("missing_effect", "ambiguous")
_STRUCTURE = (*_NAMED, "unknown_effect")
# What differs in its spread only leaves nothing for a correction of the mean.
MEAN_IS_TOLD = ("nothing_missing", "variance_effect")


@dataclass(frozen=True)
class TwinWay:
    """How a twin of tests of one kind becomes a correction.

    ``freeze``: returns the bundle of a twin, or refuses.
    ``judge``: returns what is known of that bundle from runs that were left out of all tests that they would tell of.
    ``grades``: grades that confirm an effect.
    ``little``: share of the error before that may be left, whatever the verdict says of it.
    ``geometry``: what a campaign need not say of its machine, because its kind does.
    """

    freeze: Callable[[Twin, Observations, Home], TwinBundle]
    judge: Callable[[TwinBundle, Seen, Home], Judged]
    grades: tuple[str, ...]
    quiet: tuple[str, ...]
    little: float
    geometry: Mapping[str, str] = field(default_factory=dict)

    def case(self, twins: AnyTwins, name: str, on: str, seed: int) -> Case:
        """Return what speaks for and against a twin of tests of a path."""
        seen = seen_on(twins, name, on)
        twin, obs = seen.twin, seen.obs
        require_uncorrected(obs.campaign)
        diagnosis = seen.lacks(None, seed)
        frozen = self.freeze(twin, obs, twins.home)
        gradings = tuple(_grading(term, seen, seed, self) for term in frozen.twin.terms)
        return Case(
            frozen=frozen,
            verdict=diagnosis.verdict,
            gradings=gradings,
            objections=tuple(_objections(diagnosis, gradings, frozen.twin, seen, self)),
            confirms=f"every corrected effect {self.grades[0]}, or named by tests of other kinds",
            advice=lambda: _advice(name, gradings, frozen.twin, obs),
            judge=lambda: self.judge(frozen, seen, twins.home),
            size=(len(set(obs.run_of.tolist())), obs.n_rows),
            data=twin.data,
            geometry=dict(self.geometry) | dict(obs.campaign.machine_geometry),
            predicted=tuple(_predicted(frozen, obs)),
            left=_left(diagnosis, seen.whole, self),
            by_others=lambda: _by_others(frozen, seen),
        )


def _advice(name: str, gradings: Sequence[Grading], corrected: Twin, obs: Observations) -> str:
    """Name the first thing to do: take out the weakest effect that is not needed, or look again."""
    idle = {g.label for g in gradings if g.grade == NOT_NEEDED}
    unneeded = [t for t in corrected.terms if t.label in idle]
    if not unneeded:
        return f"dtwin twin diagnose {name}"

    def cost(term: Term) -> tuple[int, float]:
        # What cannot be told apart stands for each other: keep what explains it with least.
        rest = [t for t in corrected.terms if t.label != term.label]
        needed = {
            f"{e.effect} {e.axis}" for e in fit(obs, rest).estimates if not abs(e.value) <= e.uncertainty_at_shape
        }
        return len(needed), rms(predict_um(replace(corrected, terms=(term,)), obs)[obs.mask])

    weakest = min(unneeded, key=cost).instance
    axis = f" --axis {weakest.axis}" if weakest.axis else ""
    return f"dtwin twin remove {name} {weakest.effect.name}{axis}"


def _grading(term: Term, seen: Seen, seed: int, way: TwinWay) -> Grading:
    """Say whether an effect that was left out is found again, by tests of a path or else by those of other kinds."""
    own = _by_paths(term, seen, seen.lacks(term, seed), way)
    if own.confirmed or own.grade == NOT_NEEDED:
        return own
    # A size on which tests at rest and in motion agree is an objection of its own where they do not.
    others = seen.elsewhere(term, seed)
    return Grading(term.label, f"named by {', '.join(others)}", True) if others else own


def _by_paths(term: Term, seen: Seen, without: Diagnosis, way: TwinWay) -> Grading:
    """Say whether an effect that was left out is found again, and its law confirmed; by any of the tests, where there are several."""
    if without.verdict in way.quiet:
        return Grading(term.label, NOT_NEEDED, False)
    key = key_of(term)
    group = next((g for g in without.found if any(seen.key_of(s) == key for s in g)), None)
    if group is None or without.verdict not in _NAMED:
        return Grading(term.label, f"not found again: {without.verdict}", False)
    if len(group) > 1:
        alike = ", ".join(s.label for s in group if seen.key_of(s) != key)
        return Grading(term.label, f"not told from {alike or 'others'}", False)
    own, (cause, axis) = group[0].grade, key
    tests = without.tests if isinstance(without, SeveralDiagnosis) else ()
    every = [s for test in tests for g in test.found.found for s in g]
    # A circle shows the difference of its two axes, of which another test tells one.
    mine = [s for s in every if seen.key_of(s)[0] == cause and axis in (s.axis, *AXES_OF.get(s.axis, ()))]
    grade = next((s.grade for s in mine if s.grade in way.grades), own)
    return Grading(term.label, str(grade), grade in way.grades)


def _objections(
    diagnosis: Diagnosis, gradings: Sequence[Grading], corrected: Twin, seen: Seen, way: TwinWay
) -> list[str]:
    out = []
    if diagnosis.verdict not in way.quiet and not _left(diagnosis, seen.whole, way):
        out.append(f"{diagnosis.verdict}: {diagnosis.headline}")
    out += [f"{g.label}: {g.grade}" for g in gradings if not g.confirmed]
    out += [
        f"{term.label}: {', '.join(c.campaigns)} contradicts {', '.join(c.others)}, fit a twin to those that agree"
        for term in corrected.terms
        for c in seen.disagreed_on(term)
    ]
    labels = set(corrected.labels)
    out += [
        f"{e.effect} {e.axis}".strip() + f": {e.name} cannot be told from another effect"
        for e in corrected.estimates
        if not (e.identifiable or e.is_unseen) and f"{e.effect} {e.axis}".strip() in labels
    ]
    return out


def _left(diagnosis: Diagnosis, whole: Twin, way: TwinWay) -> str:
    """Say what a diagnosis finds that is too little to object to, in each of the tests; empty without."""
    parts = whole.parts if isinstance(whole, SeveralTwin) else (whole,)
    tests = [t.found for t in diagnosis.tests] if isinstance(diagnosis, SeveralDiagnosis) else [diagnosis]
    share = max(test.systematic_rms_um / part.figures["rms_before_um"] for test, part in zip(tests, parts, strict=True))
    if diagnosis.verdict not in _STRUCTURE or not share < way.little:
        return ""
    return (
        f"{diagnosis.verdict}, but what repeats agree on is {shown_number(100 * share, 2)} % of the error (up to "
        f"{100 * way.little:g} % may be left): {diagnosis.headline}"
    )


def _by_others(frozen: TwinBundle, seen: Seen) -> ByOthers | None:
    """Leave out the whole campaign, and foretell it."""
    obs = seen.obs
    others = tuple(name for name in seen.whole.campaigns if name != obs.campaign.name)
    if not others:
        return None
    again = seen.refit(lambda test: np.arange(0 if test.campaign.name == obs.campaign.name else test.n_rows))
    kept = tuple(t for t in again.terms if t.label in frozen.twin.labels)
    unknown = tuple(label for label in frozen.twin.labels if label not in {t.label for t in kept})
    before, after = (obs.rms(frozen_residual_um(replace(again, terms=terms), obs)) for terms in ((), kept))
    return ByOthers(others, before, after, unknown)


def _predicted(frozen: TwinBundle, obs: Observations) -> list[dict[str, Any]]:
    before = frozen_residual_um(replace(frozen.twin, terms=()), obs)
    after = frozen_residual_um(frozen.twin, obs)
    out = []
    for number, condition in enumerate(obs.conditions):
        rows = obs.condition_of == number
        mask = obs.mask[rows]
        out.append(
            {
                **condition.as_dict(),
                "condition": str(condition),
                "rms_before_um": rms(before[rows][mask]),
                "rms_predicted_um": rms(after[rows][mask]),
            }
        )
    return out
