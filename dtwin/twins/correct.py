"""From a confirmed twin to a registered correction."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Protocol

import numpy as np

from dtwin.config import Home
from dtwin.errors import GateRefusal
from dtwin.kinds.registry import kind_named
from dtwin.lake.store import Lake
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
from dtwin.train.gates import Verdict
from dtwin.train.promotion import TRIAL_ONLY, check_version
from dtwin.train.registry import RegisteredVersion, Registry
from dtwin.train.results import CONDITIONS_FILE, TrainingReport
from dtwin.train.twin_terms import TwinBundle
from dtwin.twins.judged import Judged
from dtwin.twins.of_kind import AnyTwins
from dtwin.twins.seen import Seen, chosen, seen_on

BY_LAW = ("law-confirmed", "intervention-confirmed")
# Served inside of what was measured only, nothing is carried on by a law: the shape must hold there.
BY_SHAPE = ("shape-consistent", *BY_LAW)
_NAMED = ("missing_effect", "ambiguous")
_STRUCTURE = (*_NAMED, "unknown_effect")
# What is left there is bounded by what it left of the runs.
LITTLE = 0.01
# What differs in its spread only leaves nothing for a correction of the mean.
MEAN_IS_TOLD = ("nothing_missing", "variance_effect")
NOT_NEEDED = "not needed: without it the residual is at the floor"


class CorrectionWay(Protocol):
    """How a twin of one kind becomes a correction."""

    def case(self, twins: AnyTwins, name: str, on: str, seed: int) -> Case:
        """Return what speaks for and against it; ``on``: the campaign that is corrected."""


@dataclass(frozen=True)
class TwinWay:
    """The same for a twin of tests of a path.

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
        gradings = tuple(_grading(term, seen, seen.lacks(term, seed), self) for term in frozen.twin.terms)
        return Case(
            frozen=frozen,
            verdict=diagnosis.verdict,
            gradings=gradings,
            objections=tuple(_objections(diagnosis, gradings, frozen.twin, seen, self)),
            confirms=f"every corrected effect {self.grades[0]}",
            advice=lambda: _advice(name, gradings, frozen.twin, obs),
            judge=lambda: self.judge(frozen, seen, twins.home),
            size=(len(set(obs.run_of.tolist())), obs.n_rows),
            data=twin.data,
            geometry=dict(self.geometry) | dict(obs.campaign.machine_geometry),
            predicted=tuple(_predicted(frozen, obs)),
            left=_left(diagnosis, seen.whole, self),
            by_others=lambda: _by_others(frozen, seen),
        )


@dataclass(frozen=True)
class Case:
    """What speaks for and against the correction of a twin.

    ``confirms``: what must hold of its effects, beside nothing missing; ``advice``: returns the first thing to do else.
    ``judge``: returns what is known of the bundle from what was left out.
    ``size``: numbers of runs and of readings; ``data``: what was used of the lake. Others: as of :class:`Correction`.
    """

    frozen: TwinBundle
    verdict: str
    gradings: tuple[Grading, ...]
    objections: tuple[str, ...]
    confirms: str
    advice: Callable[[], str]
    judge: Callable[[], Judged]
    size: tuple[int, int]
    data: Mapping[str, Any]
    geometry: Mapping[str, Any]
    predicted: tuple[Mapping[str, Any], ...]
    left: str = ""
    by_others: Callable[[], _ByOthers | None] = lambda: None


@dataclass(frozen=True)
class Grading:
    """How well an effect of a twin is confirmed, by leaving it out and asking what is missing.

    ``grade``: ``law-confirmed`` and the like; else what a diagnosis without it says.
    """

    label: str
    grade: str
    confirmed: bool


@dataclass(frozen=True)
class _ByOthers:
    """What a twin fitted to the other campaigns makes of the error of this one, um RMS; the unit is the campaign.

    ``unknown``: corrected effects that the others do not tell.
    """

    campaigns: tuple[str, ...]
    before_um: float
    after_um: float
    unknown: tuple[str, ...]

    def told(self, campaign: str) -> str:
        """Return it for people."""
        unknown = f"; they do not tell {', '.join(self.unknown)}" if self.unknown else ""
        return (
            f"by the other campaigns alone ({', '.join(self.campaigns)}; unit: the campaign): {campaign} "
            f"{self.before_um:z.3g} -> {self.after_um:z.3g} µm RMS{unknown}"
        )


@dataclass(frozen=True)
class Correction:
    """A twin's correction in the registry.

    ``frozen``: bundle and what became of every effect.
    ``objections``: why it may only be tried; empty when nothing speaks against it.
    ``predicted``: RMS of every condition before, and after as the twin predicts it.
    ``virtual``: whether the machine is one on which evidence can be measured here.
    ``left``: what is known to be left uncorrected and does not matter; empty when nothing is.
    ``by_others``: None where the twin has no other campaign of a path.
    """

    frozen: TwinBundle
    version: RegisteredVersion
    verdict: str
    gradings: tuple[Grading, ...]
    objections: tuple[str, ...]
    gates: tuple[Verdict, ...]
    predicted: tuple[Mapping[str, Any], ...]
    virtual: bool
    left: str = ""
    by_others: _ByOthers | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return {
            "twin": self.frozen.twin.name,
            "twin_version": self.frozen.twin.version,
            "campaign": self.frozen.twin.campaign,
            "machine": self.version.machine,
            "version": self.version.version,
            "verdict": self.verdict,
            "virtual": self.virtual,
            "left": self.left,
            "trial_only": bool(self.objections),
            "objections": list(self.objections),
            "terms": [dict(vars(t)) for t in self.frozen.terms],
            "grades": [dict(vars(g)) for g in self.gradings],
            "gates": [dict(vars(g)) for g in self.gates],
            "predicted": [dict(p) for p in self.predicted],
            "by_others": {**asdict(self.by_others), "told": self.by_others.told(self.frozen.twin.campaign)}
            if self.by_others
            else None,
            "bundle_sha256": self.frozen.bundle.sha256,
        }


def correct(
    twins: AnyTwins, name: str, *, campaign: str | None = None, trial: bool = False, seed: int = 0
) -> Correction:
    """Register the correction that a twin stands for.

    ``campaign``: whose path is corrected, inside of what it measured; needed where the twin has several that can be.
    ``trial``: go on although the twin is not confirmed; such a version can be tried, never promoted.
    Raises ``GateRefusal`` when the twin lacks something, or an effect is not confirmed, and ``trial`` is not set.
    Raises ``InputError`` when no effect can be corrected by offsets of position, or the runs were measured under a
    correction.
    """
    on = chosen(twins.home, twins.newest(name), "twin_correction", campaign)
    case = kind_named(Lake(twins.home.lake).campaign(on).kind).twin_correction().case(twins, name, on, seed)
    twin = case.frozen.twin
    if case.objections and not trial:
        raise GateRefusal(
            "the twin is not confirmed well enough to move a machine",
            code="correct.not_confirmed",
            where=f"twin {name} version {twin.version}",
            got="; ".join(case.objections),
            allowed=f"nothing missing, and {case.confirms}",
            hint=f"{case.advice()}; --trial registers it for a trial only",
        )
    judged, by_others = case.judge(), case.by_others()
    report = _report(case, judged, seed)
    registry = Registry(twins.home)
    ids = registry.log_training(report, {})
    version = registry.register(report, ids[report.proposed], report.candidates[0], _description(case, by_others))
    registry.attach(
        version,
        {
            "geometry.json": json.dumps(dict(case.geometry), default=str),
            CONDITIONS_FILE: json.dumps(judged.conditions),
            "terms.json": json.dumps([vars(t) for t in case.frozen.terms], indent=1),
        },
    )
    tags = {"twin": twin.name, "twin_version": str(twin.version), "twin_campaign": twin.campaign}
    if case.objections:
        tags[TRIAL_ONLY] = "; ".join(case.objections)[:500]
    registry.mark(version, tags)
    version = registry.version(version.machine, version.version)
    _, gates = check_version(registry, version)
    return Correction(
        frozen=case.frozen,
        version=version,
        verdict=case.verdict,
        gradings=case.gradings,
        objections=case.objections,
        gates=tuple(gates),
        predicted=case.predicted,
        virtual=bool(case.geometry.get("virtual", False)),
        left=case.left,
        by_others=by_others,
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
        needed = {f"{e.effect} {e.axis}" for e in fit(obs, rest).estimates if not abs(e.value) <= e.uncertainty}
        return len(needed), rms(predict_um(replace(corrected, terms=(term,)), obs)[obs.mask])

    weakest = min(unneeded, key=cost).instance
    axis = f" --axis {weakest.axis}" if weakest.axis else ""
    return f"dtwin twin remove {name} {weakest.effect.name}{axis}"


def _grading(term: Term, seen: Seen, without: Diagnosis, way: TwinWay) -> Grading:
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
    share = max(
        found.systematic_rms_um / part.figures["rms_before_um"] for found, part in zip(tests, parts, strict=True)
    )
    if diagnosis.verdict not in _STRUCTURE or not share < way.little:
        return ""
    return (
        f"{diagnosis.verdict}, but what repeats agree on is {100 * share:.2g} % of the error (up to "
        f"{100 * way.little:g} % may be left): {diagnosis.headline}"
    )


def _by_others(frozen: TwinBundle, seen: Seen) -> _ByOthers | None:
    """Leave out the whole campaign, and foretell it."""
    obs = seen.obs
    others = tuple(name for name in seen.whole.campaigns if name != obs.campaign.name)
    if not others:
        return None
    again = seen.refit(lambda test: np.arange(0 if test.campaign.name == obs.campaign.name else test.n_rows))
    kept = tuple(t for t in again.terms if t.label in frozen.twin.labels)
    unknown = tuple(label for label in frozen.twin.labels if label not in {t.label for t in kept})
    before, after = (obs.rms(frozen_residual_um(replace(again, terms=terms), obs)) for terms in ((), kept))
    return _ByOthers(others, before, after, unknown)


def _report(case: Case, judged: Judged, seed: int) -> TrainingReport:
    twin = case.frozen.twin
    out = (t for t in case.frozen.terms if not t.included)
    findings = (f"{t.label} is not corrected: {t.how}" for t in out)
    candidate = replace(
        judged.candidate,
        findings=(*findings, *judged.candidate.findings),
        numbers={**judged.candidate.numbers, "terms": float(len(twin.labels))},
    )
    return TrainingReport(
        machine=twin.machine,
        campaign=twin.campaign,
        table_versions={k: v for k, v in case.data.items() if isinstance(v, int)},
        noise_floor_um=judged.noise_floor_um,
        rms_before_um=judged.rms_before_um,
        n_runs=case.size[0],
        n_rows=case.size[1],
        candidates=(candidate,),
        proposed=candidate.name,
        seed=seed,
    )


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


def _description(case: Case, by_others: _ByOthers | None) -> str:
    twin = case.frozen.twin
    others = f", fitted with {', '.join(by_others.campaigns)}" if by_others else ""
    lines = [
        f"Correction of twin **{twin.name}** version {twin.version}, diagnosed `{case.verdict}`, "
        f"on `{twin.campaign}`{others}.",
        "",
        *(f"- {t.label}: {'corrected. ' if t.included else 'not corrected: '}{t.how}" for t in case.frozen.terms),
    ]
    if by_others:
        lines += ["", by_others.told(twin.campaign)]
    if case.left:
        lines += ["", f"Left: {case.left}"]
    if case.objections:
        lines += ["", "**For a trial only:** " + "; ".join(case.objections)]
    return "\n".join(lines)
