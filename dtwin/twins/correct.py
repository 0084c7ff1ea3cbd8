"""From a confirmed twin to a registered correction, and what is known of it before it has moved anything."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Protocol

from dtwin.errors import GateRefusal
from dtwin.kinds.registry import kind_named
from dtwin.lake.store import Lake
from dtwin.train.gates import Verdict
from dtwin.train.promotion import TRIAL_ONLY, check_version
from dtwin.train.registry import RegisteredVersion, Registry
from dtwin.train.results import CONDITIONS_FILE, Candidate, TrainingReport
from dtwin.train.twin_terms import TwinBundle
from dtwin.twins.of_kind import AnyTwins
from dtwin.twins.seen import chosen
from dtwin.units import shown_number

LITTLE = 0.01
"""Share of the error that may be left."""
NOT_NEEDED = "not needed: without it the residual is at the floor"


class CorrectionWay(Protocol):
    """How a twin of one kind becomes a correction."""

    def case(self, twins: AnyTwins, name: str, on: str, seed: int) -> Case:
        """Return what speaks for and against it; ``on``: the campaign that is corrected."""


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
    by_others: Callable[[], ByOthers | None] = lambda: None


@dataclass(frozen=True)
class Grading:
    """How well an effect of a twin is confirmed, by leaving it out and asking what is missing.

    ``grade``: ``law-confirmed`` and the like; else what a diagnosis without it says.
    """

    label: str
    grade: str
    confirmed: bool


@dataclass(frozen=True)
class ByOthers:
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
            f"{shown_number(self.before_um)} -> {shown_number(self.after_um)} µm RMS{unknown}"
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
    by_others: ByOthers | None = None

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


def _description(case: Case, by_others: ByOthers | None) -> str:
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


NAME = "twin-correction"


@dataclass(frozen=True)
class Judged:
    """A twin's bundle with the figures that its gates read.

    ``candidate``: with scores on what was left out.
    ``noise_floor_um``: what repeats disagree by.
    ``conditions``: what was measured: a name or plane, and two numbers.
    """

    candidate: Candidate
    noise_floor_um: float
    rms_before_um: float
    conditions: tuple[tuple[str, float, float], ...]
