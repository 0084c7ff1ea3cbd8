"""Campaigns and twins of a home, a line each, kept until they change; nothing here reads samples."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Any

from dtwin.config import Home
from dtwin.errors import StoreError
from dtwin.lake.rows import by_campaign
from dtwin.lake.store import Lake
from dtwin.pipeline.kept import SEVERITIES, campaign_findings, findings_of, keep, kept_already
from dtwin.twins.of_kind import every_shelf

# Rows of so many campaigns are in memory at once.
_TOGETHER = 100


@dataclass(frozen=True)
class Overview:
    """A campaign in one line.

    ``name``, ``machine``, ``kind``, ``started``, ``ingested``: what, and when; ISO 8601.
    ``runs``, ``incomplete``, ``used``: runs, how many were cut short, and how many are not left out.
    ``last``: start of the last run that is not left out.
    """

    name: str
    machine: str
    kind: str
    started: str
    ingested: str
    runs: int
    incomplete: int
    used: int
    last: str
    setups: Sequence[str]
    planes: Sequence[str]
    directions: Sequence[str]
    radii_mm: Sequence[float]
    feeds_mm_min: Sequence[float]
    findings: Mapping[str, int]


def catalogue(home: Home) -> list[Overview]:
    """Return the campaigns, the newest ingest first.

    Rows are read of campaigns alone whose files in the lake are not those that the kept line was made of.
    """
    lake = Lake(home.lake)
    files = lake.files_by_campaign()
    before = kept_already(home, "catalogue", "campaigns", "") or {}
    lines = {name: before[name] for name in files if name in before and before[name]["files"] == files[name]}
    changed = [name for name in files if name not in lines]
    for at in range(0, len(changed), _TOGETHER):
        rows = by_campaign(lake.runs(changed[at : at + _TOGETHER], left_out=True))
        lines |= {name: {"files": files[name], "line": asdict(overview(name, mine))} for name, mine in rows.items()}
    if changed or len(lines) != len(before):
        with suppress(StoreError):  # A home that cannot be written is read all the same.
            keep(home, "catalogue", "campaigns", "", lines)
    return sorted(
        (Overview(**kept["line"]) for kept in lines.values()), key=lambda c: (c.ingested, c.name), reverse=True
    )


def outlines(home: Home) -> list[Overview]:
    """Return the campaigns of which a run is used, with name and machine alone: what the names of files do not say is read."""
    lake = Lake(home.lake)
    machines = lake.machines_by_campaign()
    unsaid = [name for name, machine in machines.items() if machine is None]
    read = {row["campaign"]: row["machine"] for row in (lake.runs(unsaid) if unsaid else ())}
    named = {name: machine for name, machine in machines.items() if machine is not None} | read
    return [Overview(name, machine, "", "", "", 0, 0, 1, "", (), (), (), (), (), {}) for name, machine in named.items()]


@dataclass(frozen=True)
class TwinLine:
    """A twin in one line.

    ``changed``: when its folder was last written, as ``twins_stamp`` tells it.
    ``newest``: its newest version, as ``history`` of its shelf gives it.
    """

    name: str
    machine: str
    changed: int
    newest: Mapping[str, Any]

    @property
    def campaigns(self) -> list[str]:
        """Campaigns that the newest version was fitted to."""
        return list(self.newest.get("campaigns", [self.newest["campaign"]]))


def twins_stamp(home: Home) -> dict[str, int]:
    """Return what changes when a twin gets a version, a diagnosis or a receipt: when its folder was last written, by name."""
    try:
        with os.scandir(home.root / "twins") as entries:
            return {entry.name: entry.stat().st_mtime_ns for entry in entries if entry.is_dir()}
    except FileNotFoundError:
        return {}


def twin_lines(home: Home) -> list[TwinLine]:
    """Return the twins of every kind, by name; files are read of those alone that changed since their line was kept."""
    stamps = twins_stamp(home)
    before = kept_already(home, "catalogue", "twins", "") or {}
    lines = {name: before[name] for name in stamps if name in before and before[name]["changed"] == stamps[name]}
    changed = sorted(set(stamps) - set(lines))
    for shelf in every_shelf(home) if changed else ():
        for name in shelf.names(changed):
            machine = str(shelf.newest_document(name)[0]["machine"])
            lines[name] = asdict(TwinLine(name, machine, stamps[name], shelf.history(name)[-1]))
    if changed or len(lines) != len(before):
        with suppress(StoreError):  # A home that cannot be written is read all the same.
            keep(home, "catalogue", "twins", "", lines)
    return [TwinLine(**lines[name]) for name in sorted(lines)]


def overview(name: str, rows: Sequence[Mapping[str, Any]]) -> Overview:
    """Return a campaign in one line. ``rows``: its rows, at least one."""
    severities = Counter(f["severity"] for row in rows for f in findings_of(row))
    severities.update(f.severity for f in campaign_findings(rows))
    used = [row for row in rows if row["left_out"] is None]
    return Overview(
        name=name,
        machine=rows[0]["machine"],
        kind=rows[0]["kind"],
        started=min((r["started"] for r in rows if r["started"]), default=""),
        ingested=max(r["ingested"] or "" for r in rows),
        runs=len(rows),
        incomplete=sum(r["status"] != "complete" for r in rows),
        used=len(used),
        last=max((r["started"] or "" for r in used), default=""),
        setups=distinct(rows, "setup"),
        planes=distinct(rows, "plane"),
        directions=distinct(rows, "direction"),
        radii_mm=distinct(rows, "radius_mm"),
        feeds_mm_min=distinct(rows, "feed_mm_min"),
        findings={name: severities[name] for name in SEVERITIES if severities[name]},
    )


def distinct(rows: Sequence[Mapping[str, Any]], name: str) -> list[Any]:
    """Return what rows state under a name, sorted, each once."""
    return sorted({row[name] for row in rows if row[name] is not None})
