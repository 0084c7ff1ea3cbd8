"""Which runs may count as evidence, and evidence as it is kept with a version in the registry: never changed, never the last word.

A record says which runs were counted and what came of them. Whoever promotes computes it again
from the lake, and compares.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any

from dtwin.config import Home
from dtwin.errors import GateRefusal, InputError
from dtwin.lake.store import Lake
from dtwin.schema import Run
from dtwin.serve.served_time import ServedStretch, served_during, served_stretches
from dtwin.train.closed_loop import WITH, WITHOUT, Evidence, EvidenceRun, Way, started_at
from dtwin.train.registry import RegisteredVersion, Registry
from dtwin.train.results import condition_name

_FOLDER = "evidence"
_SAME = ("kind", "machine", "model_sha256", "campaigns", "runs")
_FIGURES = ("before_um", "after_um", "before_ci_um", "after_ci_um", "floor_um")
# Another processor sums in another order.
_RELATIVE = 1e-6


@dataclass(frozen=True)
class Record:
    """Evidence of a version, as it was computed once.

    ``id``: twelve digits of its checksum.
    ``time``: when it was computed, ISO 8601.
    ``content``: as ``Evidence.as_dict`` gave it, with the ``notes``.
    """

    id: str
    time: str
    content: Mapping[str, Any]

    @property
    def worse(self) -> list[str]:
        """Names of the conditions in which the correction did harm."""
        return [condition_name(c) for c in self.content["conditions"] if c["worse"]]


def keep(registry: Registry, version: RegisteredVersion, evidence: Evidence) -> Record:
    """Keep evidence with a version, beside what was kept before."""
    now = datetime.now(UTC)
    content = evidence.as_dict() | {"notes": dict(evidence.notes), "time": now.isoformat()}
    text = json.dumps(content, indent=1)
    name = hashlib.sha256(text.encode()).hexdigest()[:12]
    registry.attach(version, {f"{_FOLDER}/{now:%Y%m%dT%H%M%S%f}-{name}.json": text})
    return Record(name, content["time"], content)


def records(registry: Registry, version: RegisteredVersion) -> list[Record]:
    """Return all evidence that is kept with a version, oldest first."""
    out = []
    for path in registry.files(version, _FOLDER):
        if not path.endswith(".json"):
            continue
        content = registry.read_json(version, path)
        text = json.dumps(content, indent=1)
        name = path.removesuffix(".json").rpartition("-")[2]
        if hashlib.sha256(text.encode()).hexdigest()[:12] != name or not _whole(content):
            raise GateRefusal(
                "evidence was changed after it was computed, or was not computed by dtwin",
                code="evidence.changed",
                where=path,
                hint="dtwin evidence computes it from runs",
            )
        out.append(Record(name, str(content["time"]), content))
    return out


def newest(registry: Registry, version: RegisteredVersion) -> Record | None:
    """Return the evidence that was computed last, None without any."""
    kept = records(registry, version)
    return kept[-1] if kept else None


def contrary(kept: Sequence[Record]) -> list[Record]:
    """Return the evidence before the newest that speaks against a version."""
    return [record for record in kept[:-1] if record.worse]


def require_same(record: Record, evidence: Evidence) -> None:
    """Refuse a record that differs from what its runs say now."""
    now = json.loads(json.dumps(evidence.as_dict()))
    differ = [name for name in _SAME if record.content.get(name) != now[name]]
    if differ == ["runs"]:
        differ = [_runs_differ(record.content["runs"], now["runs"])]
    if not differ:
        kept = {condition_name(c): c for c in record.content["conditions"]}
        fresh = {condition_name(c): c for c in now["conditions"]}
        differ = sorted(set(kept) ^ set(fresh)) or [
            f"{name} {figure}"
            for name, c in fresh.items()
            for figure in _FIGURES
            if not math.isclose(kept[name][figure], c[figure], rel_tol=_RELATIVE, abs_tol=1e-9)
        ]
    if differ:
        raise GateRefusal(
            "the evidence is not what its runs say",
            code="evidence.differs",
            where=f"evidence {record.id} of {record.time}",
            got=", ".join(differ[:6]),
            hint="runs were added, amended or left out since, or the evidence was not computed: "
            "dtwin evidence computes it anew",
        )


def _runs_differ(before: Sequence[Mapping[str, str]], now: Sequence[Mapping[str, str]]) -> str:
    keys = [{tuple(sorted(run.items())) for run in runs} for runs in (before, now)]
    return f"{len(keys[1] - keys[0])} other runs, {len(keys[0] - keys[1])} gone"


def _whole(content: object) -> bool:
    wanted = (*_SAME, "conditions", "time", "notes")
    return (
        isinstance(content, dict)
        and all(name in content for name in wanted)
        and all("worse" in c and all(f in c for f in _FIGURES) for c in content["conditions"])
    )


@dataclass(frozen=True)
class _Gathered:
    """Runs that may count. ``kind``: ``virtual`` when anything that was measured, or what was served, is."""

    runs: tuple[EvidenceRun, ...]
    kind: str
    told: tuple[str, ...]


def gathered(
    home: Home, machine: str, model_sha256: str, campaigns: Mapping[Way, Sequence[str]], *, virtual: bool
) -> _Gathered:
    """Return the runs of campaigns, each with the way in which it was measured.

    A campaign may be named for both ways: its runs then say themselves which one they are.

    ``home``: lake, and the journal of the serving sessions.
    ``model_sha256``: of the model whose correction is judged.
    ``virtual``: whether the machine is known to be virtual. For every other one the journal must say that the model was
    served throughout each run with it, and nothing during those without.
    Raises ``InputError`` when a campaign is unknown, or of another machine.
    Raises ``GateRefusal`` when a run was measured in another way than it is named for.
    """
    lake = Lake(home.lake)
    runs: list[EvidenceRun] = []
    told: list[str] = []
    for name in dict.fromkeys(n for names in campaigns.values() for n in names):
        known = lake.campaign(name)
        if known.machine != machine:
            raise InputError(
                "the campaign is of another machine",
                code="evidence.machine",
                where=name,
                got=known.machine,
                allowed=machine,
            )
        virtual = virtual or bool(known.machine_geometry.get("virtual", False))
        ways = [way for way in (WITHOUT, WITH) if name in campaigns.get(way, ())]
        evidence_runs, spared = _of_campaign(lake, name, ways, model_sha256)
        _require_recorded(name, known.machine_geometry, evidence_runs)
        runs += evidence_runs
        told += spared
    if virtual:
        return _Gathered(tuple(runs), "virtual", tuple(told))
    served = _served(runs, served_stretches(home, machine), model_sha256)
    if any(stretch.trial for stretch in served):
        told.append("measured on trial: the correction was limited to a quarter of its clamp")
    real = all(stretch.device == "real" for stretch in served)
    return _Gathered(tuple(runs), "real" if real else "virtual", tuple(told))


def _of_campaign(lake: Lake, name: str, ways: Sequence[Way], model_sha256: str) -> tuple[list[EvidenceRun], list[str]]:
    runs, told = [], []
    strange: dict[str, list[str]] = {}
    for row in lake.runs(name):
        label, correction = f"{name}/{row['run_id']}", row["correction"]
        way = {"": WITHOUT, model_sha256: WITH}.get(correction)
        if way is None or way not in ways:
            strange.setdefault(correction, []).append(label)
        elif row["n_errors"] or row["status"] != "complete":
            told.append(f"not counted: {label} is spoilt")
        else:
            run = lake.load(row, signals=False)
            told += [f"{label} was amended by {record['who']}: {record['because']}" for record in row["amendments"]]
            runs.append(EvidenceRun(way, name, row["content_sha256"], run))
    for correction, labels in strange.items():
        what = f"under {correction[:12]}" if correction else "without a recorded correction"
        if len(ways) > 1 and any(run.way == WITH for run in runs):
            told.append(f"not counted: {', '.join(labels)}, measured {what}")
            continue
        way = ways[-1]
        raise GateRefusal(
            f"runs were not measured {way} this correction",
            code=f"evidence.{way}",
            where=f"campaign {name}",
            got=f"{what}: {', '.join(labels[:6])}",
            allowed=f"runs under {model_sha256[:12]}" if way == WITH else "runs without a correction",
            hint="dtwin record and dtwin campaign write into the run what was served meanwhile",
        )
    return runs, told


def _require_recorded(name: str, geometry: Mapping[str, Any], runs: Sequence[EvidenceRun]) -> None:
    """Refuse a campaign that says it was corrected while none of its runs says by what."""
    if geometry.get("corrected", False) and not any(r.run.meta.correction for r in runs):
        raise GateRefusal(
            "a correction was in force during the campaign, but no run says which",
            code="evidence.without",
            where=f"campaign {name}",
            got="corrected = true",
            allowed="runs that were recorded with dtwin record or dtwin campaign",
        )


def _served(runs: Sequence[EvidenceRun], stretches: Sequence[ServedStretch], model_sha256: str) -> list[ServedStretch]:
    """Compare runs with the journal; return when the correction was served."""
    served = []
    for one in runs:
        begin = started_at(one.run)
        if begin is None:
            raise GateRefusal("a run does not say when it was measured", code="evidence.time", where=one.name)
        stretch = served_during(stretches, begin, begin + _duration(one.run), one.name)
        if one.way == WITH and (stretch is None or stretch.model_sha256 != model_sha256):
            raise GateRefusal(
                "the journal does not say that this correction was served during the run",
                code="evidence.journal",
                where=one.name,
                got=f"{stretch.model_sha256[:12]} was served" if stretch else "nothing was served",
                allowed=f"{model_sha256[:12]} from {begin.isoformat()} on, throughout the run",
            )
        if one.way == WITHOUT and stretch is not None:
            raise GateRefusal(
                "the journal says that a correction was served during a run without one",
                code="evidence.journal",
                where=one.name,
                got=f"{stretch.model_sha256[:12]} was served",
            )
        if stretch is not None:
            served.append(stretch)
    return served


def _duration(run: Run) -> timedelta:
    t_s = run.samples["t_s"]
    return timedelta(seconds=float(t_s[-1] - t_s[0]))
