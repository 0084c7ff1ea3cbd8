"""From a confirmed twin to a registered correction."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dtwin.errors import GateRefusal, InputError
from dtwin.physics.diagnose import diagnose
from dtwin.physics.diagnosis import Diagnosis
from dtwin.physics.fit import fit
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Term
from dtwin.physics.twin import Twin, frozen_residual_um, predict_um, twin_of
from dtwin.pipeline.modelling import CONDITIONS_FILE
from dtwin.pipeline.twin_data import load, pure_rms_um, require_circle
from dtwin.pipeline.twins import Twins
from dtwin.schema import Floats
from dtwin.serve.export import to_c, to_latex, to_python, to_text
from dtwin.train.gates import Verdict
from dtwin.train.latency import bundle_latency
from dtwin.train.promotion import TRIAL_ONLY, check_version
from dtwin.train.registry import RegisteredVersion, Registry
from dtwin.train.results import Candidate, Scores, TrainingReport
from dtwin.train.twin_bundle import OUTPUT, TermChoice, TwinBundle, twin_bundle

_CONFIRMED = ("law-confirmed", "intervention-confirmed")
_NAME = "twin-correction"
_VISIBLE_SHARE = 0.1
NOT_NEEDED = "not needed: without it the residual is at the floor"


@dataclass(frozen=True)
class Grading:
    """How well an effect of a twin is confirmed, by leaving it out and asking what is missing.

    Attributes
    ----------
    label : str
        Effect with axis.
    grade : str
        ``law-confirmed`` and the like; else what a diagnosis without it says.
    confirmed : bool
        Whether its law was confirmed.
    """

    label: str
    grade: str
    confirmed: bool


@dataclass(frozen=True)
class Correction:
    """A twin's correction in the registry.

    Attributes
    ----------
    frozen : TwinBundle
        Bundle and what became of every effect.
    version : RegisteredVersion
        Where it is registered.
    verdict : str
        Of the diagnosis.
    gradings : tuple of Grading
        Of the effects that are corrected.
    objections : tuple of str
        Why it may only be tried; empty when nothing speaks against it.
    gates : tuple of Verdict
        Offline gates.
    predicted : tuple of dict
        RMS of every condition before, and after as the twin predicts it.
    virtual : bool
        Whether the machine is one on which evidence can be measured here.
    """

    frozen: TwinBundle
    version: RegisteredVersion
    verdict: str
    gradings: tuple[Grading, ...]
    objections: tuple[str, ...]
    gates: tuple[Verdict, ...]
    predicted: tuple[Mapping[str, Any], ...]
    virtual: bool

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return {
            "twin": self.frozen.twin.name,
            "twin_version": self.frozen.twin.version,
            "machine": self.version.machine,
            "version": self.version.version,
            "verdict": self.verdict,
            "virtual": self.virtual,
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

    Parameters
    ----------
    twins : Twins
        Where the twin is.
    name : str
        The twin.
    trial : bool
        Go on although the twin is not confirmed; such a version can be tried, never promoted.
    seed : int
        Seed of permutations in the diagnosis.

    Raises
    ------
    GateRefusal
        When the twin lacks something, or an effect is not confirmed, and ``trial`` is not set.
    InputError
        When no effect can be corrected by offsets of position.
    """
    twin, found = twins.diagnose(name, seed=seed)
    obs = load(twins.home, twin.campaign).obs
    require_circle(obs, "a correction by a twin")
    geometry = dict(obs.campaign.machine_geometry)
    frozen = twin_bundle(twin, obs, horizon_s=float(geometry.get("correction_delay_s", 0.0)))
    gradings = _graded(frozen.twin, twin, obs, twins, seed)
    objections = tuple(_objections(found, gradings, frozen.twin))
    if objections and not trial:
        raise GateRefusal(
            "the twin is not confirmed well enough to move a machine",
            code="correct.not_confirmed",
            where=f"twin {name} version {twin.version}",
            got="; ".join(objections),
            allowed="nothing missing, and every corrected effect law-confirmed",
            hint=_advice(name, gradings, frozen.twin, obs)
            + "; --trial registers it for a trial only",
        )
    report, predicted = _report(frozen, twin, obs, seed)
    registry = Registry(twins.home)
    ids = registry.log_training(report, {})
    version = registry.register(
        report, ids[_NAME], report.candidates[0], _description(frozen, found, objections)
    )
    conditions = [(c.plane, c.radius_mm, c.feed_mm_min) for c in obs.conditions]
    registry.attach(
        version,
        {
            "geometry.json": json.dumps(geometry, default=str),
            CONDITIONS_FILE: json.dumps(sorted(set(conditions))),
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
    return Correction(
        frozen, version, found.verdict, gradings, objections, tuple(gates), predicted, virtual
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
            f"{e.effect} {e.axis}"
            for e in fit(obs, rest).estimates
            if not abs(e.value) <= e.uncertainty
        }
        return len(needed), _rms(predict_um(replace(corrected, terms=(term,)), obs)[obs.mask])

    weakest = min(unneeded, key=cost).instance
    axis = f" --axis {weakest.axis}" if weakest.axis else ""
    return f"dtwin twin remove {name} {weakest.effect.name}{axis}"


def _graded(
    corrected: Twin, twin: Twin, obs: Observations, twins: Twins, seed: int
) -> tuple[Grading, ...]:
    """Leave out each corrected effect in turn: would it be found, and its law confirmed?"""
    out = []
    for term in corrected.terms:
        others = [t for t in twin.terms if t.label != term.label]
        found = diagnose(obs, others, twins.library, seed=seed)
        out.append(_grading(term, found))
    return tuple(out)


def _grading(term: Term, found: Diagnosis) -> Grading:
    if found.verdict == "nothing_missing":
        return Grading(term.label, NOT_NEEDED, False)
    named = next((s for s in found.suspects if s.label == term.label and s.in_group), None)
    if named is None:
        return Grading(term.label, f"not found again: {found.verdict}", False)
    if found.verdict != "missing_effect":
        alike = ", ".join(s.label for s in found.group if s.label != term.label)
        return Grading(term.label, f"not told from {alike or 'others'}", False)
    grade = str(named.grade)
    return Grading(term.label, grade, grade in _CONFIRMED)


def _objections(found: Diagnosis, gradings: Sequence[Grading], corrected: Twin) -> list[str]:
    out = []
    if found.verdict != "nothing_missing":
        out.append(f"{found.verdict}: {found.headline}")
    out += [f"{g.label}: {g.grade}" for g in gradings if not g.confirmed]
    labels = set(corrected.labels)
    out += [
        f"{e.effect} {e.axis}".strip() + f": {e.name} cannot be told from another effect"
        for e in corrected.estimates
        if not e.identifiable and f"{e.effect} {e.axis}".strip() in labels
    ]
    return out


def _report(
    frozen: TwinBundle, twin: Twin, obs: Observations, seed: int
) -> tuple[TrainingReport, tuple[Mapping[str, Any], ...]]:
    left = frozen_residual_um(frozen.twin, obs)
    before = frozen_residual_um(replace(twin, terms=()), obs)
    predicted = tuple(_predicted(obs, before, left))
    bundle = frozen.bundle
    graph = bundle.tick_graph
    scores = {
        group: scored
        for group in ("feed_mm_min", "radius_mm")
        if (scored := _held_out(frozen, twin, obs, group)) is not None
    }
    candidate = Candidate(
        name=_NAME,
        family="symbolic",
        promotable=True,
        complexity=len(graph.nodes),
        scores=scores,
        train_rms_um=_rms(left[obs.mask]),
        latency=bundle_latency(bundle),
        equation=to_text(graph),
        exports={
            "equation.txt": to_text(graph),
            "equation.tex": to_latex(graph),
            "equation.py": to_python(graph),
            "equation.c": to_c(graph, bundle.tick_inputs, (), (OUTPUT,)),
        },
        bundle=bundle.to_dict(),
        findings=tuple(f"{t.label} is not corrected: {t.how}" for t in _left_out(frozen.terms)),
        numbers={"terms": float(len(frozen.twin.terms))},
    )
    report = TrainingReport(
        machine=twin.machine,
        campaign=twin.campaign,
        table_versions={k: v for k, v in twin.data.items() if isinstance(v, int)},
        noise_floor_um=pure_rms_um(obs, left),
        rms_before_um=_rms(before[obs.mask]),
        n_runs=len(set(obs.run_of.tolist())),
        n_rows=obs.n_rows,
        candidates=(candidate,),
        proposed=_NAME,
        seed=seed,
    )
    return report, predicted


def _left_out(terms: Sequence[TermChoice]) -> list[TermChoice]:
    return [t for t in terms if not t.included]


def _predicted(obs: Observations, before: Floats, after: Floats) -> list[dict[str, Any]]:
    out = []
    for number, condition in enumerate(obs.conditions):
        rows = obs.condition_of == number
        mask = obs.mask[rows]
        out.append(
            {
                **condition.as_dict(),
                "rms_before_um": _rms(before[rows][mask]),
                "rms_predicted_um": _rms(after[rows][mask]),
            }
        )
    return out


def _held_out(frozen: TwinBundle, twin: Twin, obs: Observations, group: str) -> Scores | None:
    """Fit the twin without one value of the group at a time, and predict it."""
    label = np.array([float(getattr(m, group) or 0.0) for m in obs.runs])
    values = np.unique(label)
    if len(values) < 2:
        return None
    rest, plain = np.zeros(obs.y_um.shape), np.zeros(obs.y_um.shape)
    for value in values:
        inside, outside = np.flatnonzero(label != value), np.flatnonzero(label == value)
        try:
            made = fit(obs.take(inside), list(twin.terms))
        except InputError:
            return None
        seen = twin_of(made, obs.take(inside), name=twin.name, version=1, action="", data={})
        kept = [t for t in made.terms if t.label in frozen.twin.labels]
        there = obs.take(outside)
        rest[outside] = frozen_residual_um(replace(seen, terms=tuple(kept)), there)
        plain[outside] = frozen_residual_um(replace(seen, terms=()), there)
    floor_um = pure_rms_um(obs, rest)
    ratios: dict[str, float] = {}
    for number, condition in enumerate(obs.conditions):
        rows = obs.condition_of == number
        mask = obs.mask[rows]
        # Where it changes less than repeats could show, it makes nothing worse or better.
        if _rms((rest[rows] - plain[rows])[mask]) > _VISIBLE_SHARE * floor_um:
            ratios[str(condition)] = _rms(rest[rows][mask]) / _rms(plain[rows][mask])
    if not ratios:
        return None
    worst = max(ratios, key=lambda key: ratios[key])
    found = rest[obs.mask]
    return Scores(
        group=group,
        r2=1.0 - float(np.mean(found**2) / np.mean(plain[obs.mask] ** 2)),
        rms_um=_rms(found),
        mae_um=float(np.mean(np.abs(found))),
        worst_slice_ratio=ratios[worst],
        worst_slice=worst,
        n_groups=len(values),
        n_runs=len(set(obs.run_of.tolist())),
    )


def _description(frozen: TwinBundle, found: Diagnosis, objections: Sequence[str]) -> str:
    twin = frozen.twin
    lines = [
        f"Correction of twin **{twin.name}** version {twin.version}, diagnosed `{found.verdict}`, "
        f"on `{twin.campaign}`.",
        "",
        *(
            f"- {t.label}: {'corrected. ' if t.included else 'not corrected: '}{t.how}"
            for t in frozen.terms
        ),
    ]
    if objections:
        lines += ["", "**For a trial only:** " + "; ".join(objections)]
    return "\n".join(lines)


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))
