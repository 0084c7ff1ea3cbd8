"""From a confirmed twin to a registered correction."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from dtwin.config import Home
from dtwin.errors import GateRefusal
from dtwin.kinds.registry import kind_named
from dtwin.physics.diagnose import diagnose
from dtwin.physics.diagnosis import Diagnosis
from dtwin.physics.fit import fit
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Term
from dtwin.physics.twin import Twin, frozen_residual_um, predict_um
from dtwin.statistics import rms
from dtwin.train.dataset import require_uncorrected
from dtwin.train.gates import Verdict
from dtwin.train.promotion import TRIAL_ONLY, check_version
from dtwin.train.registry import RegisteredVersion, Registry
from dtwin.train.results import CONDITIONS_FILE, TrainingReport
from dtwin.train.twin_terms import TwinBundle
from dtwin.twins.judged import Judged
from dtwin.twins.measured import load
from dtwin.twins.several import require_alone
from dtwin.twins.verbs import Twins

BY_LAW = ("law-confirmed", "intervention-confirmed")
# Served inside of what was measured only, nothing is carried on by a law: the shape must hold there.
BY_SHAPE = ("shape-consistent", *BY_LAW)
_STRUCTURE = ("missing_effect", "ambiguous", "unknown_effect")
# What is left there is bounded by what it left of the runs.
LITTLE = 0.01
# What differs in its spread only leaves nothing for a correction of the mean.
MEAN_IS_TOLD = ("nothing_missing", "variance_effect")
_NOT_NEEDED = "not needed: without it the residual is at the floor"


@dataclass(frozen=True)
class TwinWay:
    """How a twin of one kind becomes a correction.

    ``freeze``: returns the bundle of a twin, or refuses.
    ``judge``: returns what is known of that bundle from runs that were left out.
    ``grades``: grades that confirm an effect.
    ``little``: share of the error before that may be left, whatever the verdict says of it.
    ``geometry``: what a campaign need not say of its machine, because its kind does.
    """

    freeze: Callable[[Twin, Observations, Home], TwinBundle]
    judge: Callable[[TwinBundle, Twin, Observations, Home], Judged]
    grades: tuple[str, ...]
    quiet: tuple[str, ...]
    little: float
    geometry: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class _Grading:
    """How well an effect of a twin is confirmed, by leaving it out and asking what is missing.

    ``grade``: ``law-confirmed`` and the like; else what a diagnosis without it says.
    """

    label: str
    grade: str
    confirmed: bool


@dataclass(frozen=True)
class Correction:
    """A twin's correction in the registry.

    ``frozen``: bundle and what became of every effect.
    ``objections``: why it may only be tried; empty when nothing speaks against it.
    ``predicted``: RMS of every condition before, and after as the twin predicts it.
    ``virtual``: whether the machine is one on which evidence can be measured here.
    ``left``: what is known to be left uncorrected and does not matter; empty when nothing is.
    """

    frozen: TwinBundle
    version: RegisteredVersion
    verdict: str
    gradings: tuple[_Grading, ...]
    objections: tuple[str, ...]
    gates: tuple[Verdict, ...]
    predicted: tuple[Mapping[str, Any], ...]
    virtual: bool
    left: str = ""

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return {
            "twin": self.frozen.twin.name,
            "twin_version": self.frozen.twin.version,
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
            "bundle_sha256": self.frozen.bundle.sha256,
        }


def correct(twins: Twins, name: str, *, trial: bool = False, seed: int = 0) -> Correction:
    """Register the correction that a twin stands for.

    ``trial``: go on although the twin is not confirmed; such a version can be tried, never promoted.
    Raises ``GateRefusal`` when the twin lacks something, or an effect is not confirmed, and ``trial`` is not set.
    Raises ``InputError`` when no effect can be corrected by offsets of position, or the runs were measured under a
    correction.
    """
    obs = load(twins.home, require_alone(twins.newest(name), "a correction").campaign).obs
    require_uncorrected(obs.campaign)
    twin, diagnosis = twins.diagnose(name, seed=seed)
    way = kind_named(obs.grid.kind).twin_correction()
    frozen = way.freeze(twin, obs, twins.home)
    gradings = _graded(frozen.twin, twin, obs, twins, way, seed)
    objections = tuple(_objections(diagnosis, gradings, frozen.twin, way))
    if objections and not trial:
        raise GateRefusal(
            "the twin is not confirmed well enough to move a machine",
            code="correct.not_confirmed",
            where=f"twin {name} version {twin.version}",
            got="; ".join(objections),
            allowed=f"nothing missing, and every corrected effect {way.grades[0]}",
            hint=_advice(name, gradings, frozen.twin, obs) + "; --trial registers it for a trial only",
        )
    left = _left(diagnosis, frozen.twin, way)
    judged = way.judge(frozen, twin, obs, twins.home)
    report = _report(frozen, judged, twin, obs, seed)
    registry = Registry(twins.home)
    ids = registry.log_training(report, {})
    version = registry.register(
        report, ids[report.proposed], report.candidates[0], _description(frozen, diagnosis, objections, left)
    )
    geometry = dict(way.geometry) | dict(obs.campaign.machine_geometry)
    registry.attach(
        version,
        {
            "geometry.json": json.dumps(geometry, default=str),
            CONDITIONS_FILE: json.dumps(judged.conditions),
            "terms.json": json.dumps([vars(t) for t in frozen.terms], indent=1),
        },
    )
    tags = {"twin": twin.name, "twin_version": str(twin.version)}
    if objections:
        tags[TRIAL_ONLY] = "; ".join(objections)[:500]
    registry.mark(version, tags)
    version = registry.version(version.machine, version.version)
    _, gates = check_version(registry, version)
    virtual = bool(geometry.get("virtual", False))
    predicted = tuple(_predicted(frozen, obs))
    return Correction(frozen, version, diagnosis.verdict, gradings, objections, tuple(gates), predicted, virtual, left)


def _advice(name: str, gradings: Sequence[_Grading], corrected: Twin, obs: Observations) -> str:
    """Name the first thing to do: take out the weakest effect that is not needed, or look again."""
    idle = {g.label for g in gradings if g.grade == _NOT_NEEDED}
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


def _graded(
    corrected: Twin, twin: Twin, obs: Observations, twins: Twins, way: TwinWay, seed: int
) -> tuple[_Grading, ...]:
    """Leave out each corrected effect in turn: would it be found, and its law confirmed?"""
    out = []
    for term in corrected.terms:
        others = [t for t in twin.terms if t.label != term.label]
        diagnosis = diagnose(obs, others, twins.library, seed=seed)
        out.append(_grading(term, diagnosis, way))
    return tuple(out)


def _grading(term: Term, diagnosis: Diagnosis, way: TwinWay) -> _Grading:
    if diagnosis.verdict in way.quiet:
        return _Grading(term.label, _NOT_NEEDED, False)
    named = next((s for s in diagnosis.suspects if s.label == term.label and s.in_group), None)
    if named is None:
        return _Grading(term.label, f"not found again: {diagnosis.verdict}", False)
    if diagnosis.verdict != "missing_effect":
        alike = ", ".join(s.label for s in diagnosis.group if s.label != term.label)
        return _Grading(term.label, f"not told from {alike or 'others'}", False)
    grade = str(named.grade)
    return _Grading(term.label, grade, grade in way.grades)


def _objections(diagnosis: Diagnosis, gradings: Sequence[_Grading], corrected: Twin, way: TwinWay) -> list[str]:
    out = []
    if diagnosis.verdict not in way.quiet and not _left(diagnosis, corrected, way):
        out.append(f"{diagnosis.verdict}: {diagnosis.headline}")
    out += [f"{g.label}: {g.grade}" for g in gradings if not g.confirmed]
    labels = set(corrected.labels)
    out += [
        f"{e.effect} {e.axis}".strip() + f": {e.name} cannot be told from another effect"
        for e in corrected.estimates
        if not (e.identifiable or e.is_unseen) and f"{e.effect} {e.axis}".strip() in labels
    ]
    return out


def _left(diagnosis: Diagnosis, twin: Twin, way: TwinWay) -> str:
    """Say what a diagnosis finds that is too little to object to; empty without."""
    share = diagnosis.systematic_rms_um / twin.figures["rms_before_um"]
    if diagnosis.verdict not in _STRUCTURE or not share < way.little:
        return ""
    return (
        f"{diagnosis.verdict}, but what repeats agree on is {100 * share:.2g} % of the error (up to "
        f"{100 * way.little:g} % may be left): {diagnosis.headline}"
    )


def _report(frozen: TwinBundle, judged: Judged, twin: Twin, obs: Observations, seed: int) -> TrainingReport:
    out = (t for t in frozen.terms if not t.included)
    findings = (f"{t.label} is not corrected: {t.how}" for t in out)
    candidate = replace(
        judged.candidate,
        findings=(*findings, *judged.candidate.findings),
        numbers={**judged.candidate.numbers, "terms": float(len(frozen.twin.terms))},
    )
    return TrainingReport(
        machine=twin.machine,
        campaign=twin.campaign,
        table_versions={k: v for k, v in twin.data.items() if isinstance(v, int)},
        noise_floor_um=judged.noise_floor_um,
        rms_before_um=judged.rms_before_um,
        n_runs=len(set(obs.run_of.tolist())),
        n_rows=obs.n_rows,
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


def _description(frozen: TwinBundle, diagnosis: Diagnosis, objections: Sequence[str], left: str) -> str:
    twin = frozen.twin
    lines = [
        f"Correction of twin **{twin.name}** version {twin.version}, diagnosed `{diagnosis.verdict}`, "
        f"on `{twin.campaign}`.",
        "",
        *(f"- {t.label}: {'corrected. ' if t.included else 'not corrected: '}{t.how}" for t in frozen.terms),
    ]
    if left:
        lines += ["", f"Left: {left}"]
    if objections:
        lines += ["", "**For a trial only:** " + "; ".join(objections)]
    return "\n".join(lines)
