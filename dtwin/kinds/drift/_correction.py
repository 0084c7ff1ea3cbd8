"""A twin of drift as a correction: the equation of its terms, judged by stretches of time and logs that were left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np

from dtwin.errors import InputError
from dtwin.features.time_alone import TIME_ALONE
from dtwin.kinds.drift._data import Loaded, longest_first
from dtwin.kinds.drift._diagnosis import DriftDiagnosis, diagnose, written
from dtwin.kinds.drift._model import Fitted, Series, Term, fitted
from dtwin.kinds.drift._series import series_of
from dtwin.kinds.drift._training import log_candidate, moved_since
from dtwin.kinds.drift._twins import DriftTwin, DriftTwins
from dtwin.lake.store import Lake
from dtwin.physics.twin import Twin
from dtwin.serve.bundle import Bundle
from dtwin.statistics import rms
from dtwin.train.twin_terms import TermChoice, TwinBundle
from dtwin.twins.correct import LITTLE, NAME, NOT_NEEDED, Case, Grading, Judged
from dtwin.twins.of_kind import AnyTwins
from dtwin.units import shown_number

_HOW = "offset of {axis} by its temperature, zero where the log began"


class _LogWay:
    """How a twin of a log becomes a correction: no effect of it needs another law than its shape."""

    def case(self, twins: AnyTwins, name: str, on: str, seed: int) -> Case:
        whole = twins.newest(name)
        twin = cast("DriftTwin", next(p for p in getattr(whole, "members", (whole,)) if on in p.campaigns))
        loaded = DriftTwins(twins.home).loaded(on)
        if loaded.axis not in ("X", "Y", "Z") or not twin.terms:
            raise InputError(
                "the twin is no correction of an axis",
                code="correct.axis",
                where=f"twin {name} version {twin.version}, log {loaded.run_id}",
                got="no effect" if not twin.terms else f"axis {loaded.axis or 'not stated'}",
                allowed="an effect, and the axis along which the log was measured: X, Y or Z",
                hint="dtwin twin discover"
                if not twin.terms
                else f"dtwin amend {on} --set condition.axis=Z --because WHY",
            )
        said = diagnose(loaded.series, twin.terms)
        gradings = tuple(_grading(loaded.series, twin.terms, term) for term in twin.terms)
        model = replace(fitted(loaded.series, twin.terms), value=np.array([0.0, *twin.document["per_kelvin"]]))
        candidate = log_candidate(NAME, model, loaded.series, twin.machine, loaded.axis, _versions(loaded))
        assert candidate.bundle is not None
        others = _foretold(Lake(twins.home.lake), loaded, model)
        how = _HOW.format(axis=loaded.axis)
        campaign = Lake(twins.home.lake).campaign(on)
        held_um, before_um = said.figures["held_out_rms_um"], rms(moved_since(loaded.series))
        predicted = [{"condition": f"log {loaded.run_id}", "rms_before_um": before_um, "rms_predicted_um": held_um}]
        predicted += others
        terms = tuple(TermChoice(label, True, how) for label in twin.labels)
        judged = Judged(
            replace(candidate, findings=(f"fitted to {loaded.run_id}, the log of the twin",)),
            loaded.series.floor_um,
            before_um,
            ((on, 0.0, 0.0),),
        )
        left = _left(said)
        return Case(
            frozen=TwinBundle(Bundle.from_dict(candidate.bundle), terms, cast("Twin", twin)),
            verdict=said.verdict,
            gradings=gradings,
            objections=tuple(_objections(said, gradings, others, left)),
            confirms="every effect needed, told from time alone, and no log made worse that was not fitted",
            advice=lambda: _advice(name, said, gradings, twin.terms),
            judge=lambda: judged,
            size=(1 + len(others), len(loaded.series.t_s)),
            data=twin.document["data"],
            geometry=campaign.machine_geometry,
            predicted=tuple(predicted),
            left=left,
        )


WAY = _LogWay()


def _grading(series: Series, terms: Sequence[Term], term: Term) -> Grading:
    """Say whether a sensor is missed when it is left out, and is told from others and from time alone."""
    said = diagnose(series, [t for t in terms if t != term])
    label = written(term)
    if not said.group:
        together = (
            "not found again when it is left out: more than noise is then left, and no sensor alone surely explains it; it tells only "
            f"together with the others: log a time in which {term.name} moves and they do not, fit with it, and diagnose"
        )
        return Grading(label, NOT_NEEDED if said.verdict == "nothing_missing" else together, False)
    if all(one.added.channel != term.channel for one in said.group):
        return Grading(label, f"not found again: {said.additions[0]}", False)
    alike = [written(one.added) for one in said.group if one.added.channel != term.channel]
    alike += [TIME_ALONE] if any(one.is_as_time for one in said.group) else []
    if alike:
        return Grading(label, f"not told from {', '.join(alike)}", False)
    return Grading(label, "shape-consistent", True)


def _left(said: DriftDiagnosis) -> str:
    """Say what is left that is too little to object to; empty without."""
    beyond_um = float(np.sqrt(max(said.figures["held_out_rms_um"] ** 2 - said.figures["noise_floor_um"] ** 2, 0.0)))
    share = beyond_um / said.figures["rms_before_um"]
    if said.verdict in ("nothing_missing", "need_repeats") or not share < LITTLE:
        return ""
    return f"{said.verdict}, but it is {shown_number(100 * share, 2)} % of what moved (up to {100 * LITTLE:g} % may be left): {said.headline}"


def _objections(
    said: DriftDiagnosis, gradings: Sequence[Grading], others: Sequence[dict[str, Any]], left: str
) -> list[str]:
    out = [] if said.verdict == "nothing_missing" or left else [f"{said.verdict}: {said.headline}"]
    out += [f"{g.label}: {g.grade}" for g in gradings if not g.confirmed]
    out += [
        f"{one['condition']}, which was not fitted, gets worse: {shown_number(one['rms_before_um'])} -> {shown_number(one['rms_predicted_um'])} µm RMS"
        for one in others
        if one["rms_predicted_um"] > one["rms_before_um"]
    ]
    return out


def _advice(name: str, said: DriftDiagnosis, gradings: Sequence[Grading], terms: Sequence[Term]) -> str:
    idle = {g.label for g in gradings if g.grade == NOT_NEEDED} | {written(term) for term in said.idle}
    if said.group or not idle:
        return f"dtwin twin diagnose {name}"
    return f"dtwin twin remove {name} {next(written(term) for term in terms if written(term) in idle)}"


def _foretold(lake: Lake, loaded: Loaded, model: Fitted) -> list[dict[str, Any]]:
    """Return what the twin makes of the other sound logs of its axis and campaign, zero where each began."""
    rows = [row for row in lake.runs(loaded.campaign) if row["n_errors"] == 0 and not row["correction"]]
    out = []
    for run in longest_first([lake.load(row) for row in rows]):
        same = str(run.meta.condition.get("axis", "")).upper() == loaded.axis and run.meta.run_id != loaded.run_id
        series = series_of(run)
        if same and all(term.channel in series.temperatures_c for term in model.terms):
            told = sum(v * series.column(t) for t, v in zip(model.terms, model.value[1:], strict=True))
            left = replace(series, moved_um=series.moved_um - np.asarray(told))
            before, after = (float(np.std(one.moved_um)) for one in (series, left))
            out.append({"condition": f"log {run.meta.run_id}", "rms_before_um": before, "rms_predicted_um": after})
    return out


def _versions(loaded: Loaded) -> dict[str, int]:
    return {k: v for k, v in loaded.data.items() if isinstance(v, int)}
