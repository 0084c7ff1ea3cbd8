"""Diagnoses that are kept beside the versions of twins, and read again while nothing has changed that they depend on; contradictions beside what the machine's record says."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

import dtwin
from dtwin.config import Home
from dtwin.documents import read_document
from dtwin.errors import StoreError
from dtwin.machine_record import Event, events_between, events_of
from dtwin.physics._law_search import ScalingLaw
from dtwin.physics._laws import LawTest
from dtwin.physics._screen import Channel
from dtwin.physics.contradictions import Contradiction
from dtwin.physics.diagnosis import Diagnosis, Spread, Suspect, Unresolved
from dtwin.physics.effect import Effect
from dtwin.physics.fit import Estimate
from dtwin.physics.joint import MachineTest
from dtwin.physics.observations import Observations
from dtwin.physics.several_diagnosis import SeveralDiagnosis
from dtwin.physics.several_twin import SeveralTwin, started_of
from dtwin.physics.twin import Twin, data_lines
from dtwin.twins.diagnosing_code import MADE_BY, diagnosing_code
from dtwin.twins.measured import Loaded
from dtwin.twins.registration import diagnosis_path

MADE_FROM = "made_from"
"""Where a stored diagnosis says what it was made from."""
ALONE = "alone"
"""Where a stored diagnosis of several campaigns has that of each by itself."""


def made_from(path: Path, loaded: Loaded, library: Mapping[str, Effect], seed: int) -> str:
    """Return a check sum of all that a diagnosis depends on; empty with effects of others, whose code is not known.

    ``path``: file of the twin's version.
    ``loaded``: what it was fitted to.
    ``library``: effects that may be missing.
    """
    if not is_built_in(library):
        return ""
    digest = hashlib.sha256(path.read_bytes())
    for part in (
        *_parts(loaded.obs),
        repr((data_lines(loaded.data), sorted(library), seed)).encode(),
        diagnosing_code().encode(),
    ):
        digest.update(part)
    return digest.hexdigest()


def made_from_several(check_sums: Sequence[str], contradictions: Sequence[Contradiction]) -> str:
    """Return the same of what several campaigns say together; ``contradictions``: of the twin, with what is recorded of them."""
    return hashlib.sha256(repr((check_sums, contradictions)).encode()).hexdigest() if all(check_sums) else ""


def made_from_rows(path: Path, rows: Sequence[Mapping[str, Any]], seed: int) -> str:
    """Return the same of a campaign that has no grid; ``rows``: its runs in the lake, with all that is said of them."""
    digest = hashlib.sha256(path.read_bytes())
    digest.update(repr(([sorted(row.items()) for row in rows], seed)).encode())
    digest.update(diagnosing_code().encode())
    return digest.hexdigest()


def is_built_in(library: Mapping[str, Effect]) -> bool:
    """Tell whether all effects are dtwin's own."""
    return all(effect.regressors.__module__.startswith(f"{dtwin.__name__}.") for effect in library.values())


def kept_diagnosis(path: Path, check_sum: str) -> Diagnosis | None:
    """Return the diagnosis of a twin's version; None when none is kept, it is damaged, or was made from something else.

    ``path``, ``check_sum``: as ``made_from`` takes and gives them.
    """
    document = _stored(path) if check_sum else {}
    return _diagnosis(document) if document.get(MADE_FROM) == check_sum else None


def kept_several(
    path: Path, check_sum: str, twin: SeveralTwin, campaigns: Sequence[Observations], alone: Sequence[Diagnosis | None]
) -> SeveralDiagnosis | None:
    """Return the same of a twin of several campaigns: what they say together.

    ``alone``: what is kept of each by itself.
    """
    document = _stored(path) if check_sum else {}
    tests = tuple(
        MachineTest(obs.campaign.name, started_of(obs), obs, told, twin.on(obs.campaign.name).terms)
        for obs, told in zip(campaigns, alone, strict=True)
        if told is not None
    )
    if document.get(MADE_FROM) != check_sum or not check_sum or len(tests) < len(campaigns):
        return None
    # What several say of a candidate is where it was found, too.
    plain = [{name: value for name, value in one.items() if name != "campaign"} for one in document["candidates"]]
    diagnosis = _diagnosis({**document, "candidates": plain})
    own = {*diagnosis.as_dict(), MADE_FROM, MADE_BY, ALONE, "twin", "version", "campaign"} - {"candidates"}
    more = {name: value for name, value in document.items() if name not in own}
    return _Several(**vars(diagnosis), tests=tests, more=more)


def kept_alone(path: Path, check_sums: Sequence[str]) -> list[Diagnosis | None]:
    """Return the same of each campaign of a twin of several, diagnosed by itself beside the effects of the twin.

    ``check_sums``: of each.
    """
    documents = _stored(path).get(ALONE, [])
    by_source = {document.get(MADE_FROM): document for document in documents}
    return [_diagnosis(by_source[one]) if one and one in by_source else None for one in check_sums]


def kept_document(path: Path, check_sums: Sequence[str]) -> dict[str, Any]:
    """Return what is stored of the diagnosis of a twin of several kinds; empty where it was made from something else.

    ``check_sums``: of each fit.
    """
    document = _stored(path) if all(check_sums) else {}
    return document if document.get(MADE_FROM) == list(check_sums) else {}


def _stored(path: Path) -> dict[str, Any]:
    file = diagnosis_path(path)
    try:
        return read_document(file) if file.exists() else {}
    except StoreError:
        return {}


def _parts(obs: Observations) -> Iterator[bytes]:
    """Yield what was measured, and what is said of it."""
    for values in (obs.y_um, obs.mask, obs.condition_of, obs.setup_of, obs.run_of, obs.feed_mm_s, obs.grid.points):
        yield values.tobytes()
    for row in obs.columns:
        for name, value in sorted(row.items()):
            yield name.encode() + np.asarray(value).tobytes()
    yield repr((obs.grid.kind, obs.campaign, obs.runs, obs.conditions, obs.setups)).encode()


def _diagnosis(document: Mapping[str, Any]) -> Diagnosis:
    """Return a diagnosis from what its ``as_dict`` gave; null in place of a number is NaN."""
    unresolved, spread = document["unresolved"], document["variance"]
    return Diagnosis(
        verdict=document["verdict"],
        headline=document["headline"],
        floor_kind=document["floor_kind"],
        **_numbers(document, "residual_rms_um", "systematic_rms_um", "noise_floor_um", "lack_of_fit_p"),
        suspects=tuple(_suspect(entry) for entry in document["candidates"]),
        found=tuple(tuple(_suspect(entry) for entry in group) for group in document["found"]),
        unresolved=None
        if unresolved is None
        else Unresolved(
            **{**unresolved, **_numbers(unresolved, "share", "p_value"), "where": tuple(unresolved["where"])}
        ),
        where=tuple(document["where"]),
        channels=tuple(Channel(**{**c, "instead": tuple(c["instead"])}) for c in document["channels"]),
        laws=tuple(ScalingLaw(**{k: v for k, v in law.items() if k != "equation"}) for law in document["laws"]),
        places=tuple(document.get("places", ())),
        closest=document["closest"],
        invisible=tuple(document["invisible"]),
        untestable=document["untestable"],
        outlier_runs=tuple(document["outlier_runs"]),
        told=tuple(document["told"]),
        spread=Spread(tuple(spread["depends_on"]), spread["p_value"]) if spread else None,
        next_experiment=document["next_experiment"],
        undecided=tuple(tuple(group) for group in document["undecided"]),
    )


@dataclass(frozen=True)
class _Several(SeveralDiagnosis):
    """What several campaigns say together, read again; ``more``: what was stored beside what every diagnosis says."""

    more: Mapping[str, Any] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        return {**Diagnosis.as_dict(self), **self.more}


def _suspect(entry: Mapping[str, Any]) -> Suspect:
    tuples = {name: tuple(entry[name]) for name in ("confounded_with", "tested", "untested")}
    laws = tuple(LawTest(law["variable"], **_numbers(law, "p_value", "shift", "uncertainty")) for law in entry["laws"])
    sizes = tuple(Estimate.of(size) for size in entry["sizes"])
    numbers = _numbers(entry, "rms_after_um", "cv_gain", "p_value", "share")
    return Suspect(**{**entry, **numbers, **tuples, "laws": laws, "sizes": sizes})


def _numbers(entry: Mapping[str, Any], *names: str) -> dict[str, float]:
    return {name: float("nan") if entry[name] is None else entry[name] for name in names}


@dataclass(frozen=True)
class _RecordedContradiction(Contradiction):
    """A contradiction, and what was recorded of the machine meanwhile.

    ``between``: start of the last test with the older value, and of the first with the newer one, ISO 8601; of a single
    test that differs from those before and after it, also of the next one. Empty where days do not part the tests.
    ``events``: what was recorded from each of these days to the next, JSON-ready.
    """

    between: tuple[str, ...] = ()
    events: tuple[tuple[Mapping[str, str], ...], ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return {**super().as_dict(), "between": list(self.between), "events": [list(told) for told in self.events]}


def with_record(home: Home, twin: Twin) -> Twin:
    """Return a twin whose contradictions say what the record of its machine, as it is now, holds of their days."""
    if not isinstance(twin, SeveralTwin) or not twin.contradictions:
        return twin
    started = {part.campaign: str(about["started"]) for part, about in zip(twin.parts, twin.about, strict=True)}
    return replace(twin, contradictions=recorded(home, twin.machine, started, twin.contradictions))


def recorded(
    home: Home, machine: str, started: Mapping[str, str], contradictions: Sequence[Contradiction]
) -> tuple[Contradiction, ...]:
    """Return contradictions with what the record of their machine holds of their days; ``started``: of each campaign."""
    events = events_of(home, machine) if contradictions else ()
    return tuple(_recorded(one, started, events) for one in contradictions)


def _recorded(one: Contradiction, started: Mapping[str, str], events: Sequence[Event]) -> _RecordedContradiction:
    between = _between(*([started[name] for name in names] for names in (one.campaigns, one.others)))
    pairs = itertools.pairwise(between)
    told = tuple(tuple(e.as_dict() for e in events_between(events, *days)) for days in pairs)
    return _RecordedContradiction(**{**vars(one), "between": between, "events": told})


def _between(mine: Sequence[str], theirs: Sequence[str]) -> tuple[str, ...]:
    if not all((*mine, *theirs)):
        return ()
    for older, newer in ((mine, theirs), (theirs, mine)):
        if max(older) < min(newer):
            return max(older), min(newer)
    if len(mine) > 1:
        return ()
    (day,) = mine
    before, after = [other for other in theirs if other <= day], [other for other in theirs if other > day]
    return (max(before), day, min(after)) if before and after else ()
