"""What the lake's rows say of its campaigns; nothing here reads samples."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from dtwin.lake.rows import meta_of
from dtwin.physics.effect import Effect
from dtwin.physics.library import campaign_instances
from dtwin.physics.state import AXES_OF
from dtwin.pipeline.findings import SEVERITIES, campaign_findings, findings_of


@dataclass(frozen=True)
class Overview:
    """A campaign in one line.

    ``name``, ``machine``, ``kind``, ``started``, ``ingested``: what, and when; ISO 8601.
    ``runs``, ``incomplete``: runs, and how many were cut short.
    """

    name: str
    machine: str
    kind: str
    started: str
    ingested: str
    runs: int
    incomplete: int
    setups: tuple[str, ...]
    planes: tuple[str, ...]
    directions: tuple[str, ...]
    radii_mm: tuple[float, ...]
    feeds_mm_min: tuple[float, ...]
    findings: Mapping[str, int]


def overviews(rows: Sequence[Mapping[str, Any]]) -> list[Overview]:
    """Return the campaigns, the newest ingest first.

    ``rows``: as ``Lake.runs`` returns them.
    """
    by_name: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        by_name.setdefault(row["campaign"], []).append(row)
    found = [overview(name, mine) for name, mine in by_name.items()]
    return sorted(found, key=lambda c: (c.ingested, c.name), reverse=True)


def overview(name: str, rows: Sequence[Mapping[str, Any]]) -> Overview:
    """Return a campaign in one line.

    ``rows``: its rows, at least one.
    """
    severities = Counter(f["severity"] for row in rows for f in findings_of(row))
    severities.update(f.severity for f in campaign_findings(rows))
    return Overview(
        name=name,
        machine=rows[0]["machine"],
        kind=rows[0]["kind"],
        started=min((r["started"] for r in rows if r["started"]), default=""),
        ingested=max(r["ingested"] or "" for r in rows),
        runs=len(rows),
        incomplete=sum(r["status"] != "complete" for r in rows),
        setups=_distinct(rows, "setup"),
        planes=_distinct(rows, "plane"),
        directions=_distinct(rows, "direction"),
        radii_mm=_distinct(rows, "radius_mm"),
        feeds_mm_min=_distinct(rows, "feed_mm_min"),
        findings={name: severities[name] for name in SEVERITIES if severities[name]},
    )


def possible_effects(rows: Sequence[Mapping[str, Any]], library: Mapping[str, Effect]) -> list[Effect]:
    """Return the effects that can act in a campaign, set-up terms left out, by name.

    ``rows``: its rows, at least one.
    """
    planes = _distinct(rows, "plane")
    alone = {str(axis) for row in rows if (axis := meta_of(row).condition.get("axis"))}
    axes = sorted({axis for plane in planes for axis in AXES_OF[plane]} | alone)
    geometry = json.loads(rows[0]["geometry_json"])
    found = campaign_instances(library, rows[0]["kind"], planes, axes, geometry)
    effects = {i.effect.name: i.effect for i in found if not i.effect.setup}
    return [effects[name] for name in sorted(effects)]


def _distinct(rows: Sequence[Mapping[str, Any]], name: str) -> tuple[Any, ...]:
    return tuple(sorted({row[name] for row in rows if row[name] is not None}))
