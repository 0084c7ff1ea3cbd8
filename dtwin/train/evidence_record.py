"""Evidence as it is kept with a version in the registry: never changed, never the last word.

A record says which runs were counted and what came of them. Whoever promotes computes it again
from the lake, and compares.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from dtwin.errors import GateRefusal
from dtwin.train.evidence import Evidence
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
