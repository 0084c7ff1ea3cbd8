"""Campaign folders: ``campaign.toml`` and the files it names."""

from __future__ import annotations

import os
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from dtwin.acquire import _stated as stated
from dtwin.acquire._recovery import signal_findings
from dtwin.acquire._tabular import read_columns
from dtwin.acquire._trace_json import read_trace_json
from dtwin.acquire.b5r import read_b5r
from dtwin.acquire.foreign_table import house_file
from dtwin.acquire.signal_files import is_table_of_signals, read_signals
from dtwin.acquire.xmlsafe import read_bounded
from dtwin.atomic import write_toml
from dtwin.errors import InputError
from dtwin.kinds.kind import Kind
from dtwin.kinds.registry import kind_named, kind_names
from dtwin.lake.store import RejectedRows
from dtwin.schema import (
    DEFAULT_KIND,
    MIXED_CORRECTION,
    Campaign,
    Direction,
    Finding,
    Run,
    RunMeta,
    require_name,
    standard_plane,
)

_NUMBERS = ("radius_mm", "feed_mm_min")
_MAX_TOML_BYTES = 16 * 1024 * 1024
RUN_KEYS = frozenset(
    {
        "id",
        "file",
        "plane",
        "radius_mm",
        "feed_mm_min",
        "direction",
        "repeat",
        "setup",
        "started",
        "signals",
        "covariates",
        "sample_rate_hz",
        "condition",
        "correction",
    }
)


@dataclass(frozen=True)
class FolderEntry:
    """One ``[[run]]`` of a campaign file, checked but not yet read.

    Attributes:
        run_id: As stated; a ``.b5r`` becomes ``id-ccw`` and ``id-cw``.
        file: Samples of the reference instrument.
    """

    run_id: str
    file: Path
    signals: tuple[Path, ...]
    stated: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class CampaignFolder:
    """A campaign and its runs, readable one by one."""

    campaign: Campaign
    entries: tuple[FolderEntry, ...]

    def read(self, entry: FolderEntry) -> tuple[list[Run], list[RejectedRows]]:
        """Read the runs of one entry.

        Args:
            entry: One of ``entries``.

        Returns:
            Usually one run, two for a bidirectional file; and rows that were left out.
        """
        runs, rejected = _read_entry(entry, self.campaign)
        groups = tuple(group for path in entry.signals for group in read_signals(path))
        by_direction = {
            run.meta.run_id: tuple(
                replace(g, name=g.name.rsplit("@", 1)[0])
                for g in groups
                if "@" not in g.name or g.name.rsplit("@", 1)[1].upper() == run.meta.direction
            )
            for run in runs
        }
        noticed = tuple(f for path in entry.signals if not is_table_of_signals(path) for f in signal_findings(path))
        complete = [replace(r, signals=by_direction[r.meta.run_id], findings=(*r.findings, *noticed)) for r in runs]
        return complete, rejected

    def __iter__(self) -> Iterator[tuple[list[Run], list[RejectedRows]]]:
        return (self.read(entry) for entry in self.entries)


def open_campaign(folder: Path) -> CampaignFolder:
    """Read and check ``campaign.toml`` without reading the measurements.

    Args:
        folder: The campaign folder, or the toml itself.

    Raises:
        InputError: With the place of the first thing that is wrong.
    """
    path = folder / "campaign.toml" if folder.is_dir() else folder
    if folder.is_dir() and not path.exists():
        raise InputError(
            "this folder is no campaign: it has no campaign.toml",
            code="file.missing",
            where=str(folder),
            hint="name a folder that dtwin record or dtwin simulate made, or a .b5r file; "
            "your own: docs/how-to/ingest-your-own.md",
        )
    try:
        document = tomllib.loads(read_bounded(path, _MAX_TOML_BYTES).decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise InputError(
            "campaign.toml is not readable", code="campaign.toml", where=str(path), got=str(error)[:200]
        ) from error
    head = document.get("campaign")
    stated_runs = document.get("run")
    if not isinstance(head, dict) or not isinstance(stated_runs, list) or not stated_runs:
        raise InputError(
            "campaign.toml needs a [campaign] table and at least one [[run]]", code="campaign.toml", where=str(path)
        )
    campaign = campaign_from(head, path)
    entries = [entry_from(e, n, path) for n, e in enumerate(stated_runs, start=1)]
    ids = [entry.run_id for entry in entries]
    twice = sorted({i for i in ids if ids.count(i) > 1}) if len(set(ids)) < len(ids) else []
    if twice:
        raise InputError(
            "a run id occurs twice", code="ingest.duplicate_run", where=str(path), got=", ".join(twice[:10])
        )
    return CampaignFolder(campaign, tuple(entries))


def campaign_from(head: Mapping[str, Any], path: Path) -> Campaign:
    """Return the campaign that a table ``[campaign]`` states."""
    known = {field.name for field in fields(Campaign)}
    unknown = sorted(set(head) - known)
    if unknown:
        # Tables of a campaign; a condition is of a run.
        places = [t for t in ("instrument", "machine_geometry") if unknown[0] in stated.OF_EVERY_KIND[t].split()]
        raise InputError(
            "unknown setting of a campaign",
            code="campaign.setting",
            where=str(path),
            got=", ".join(unknown)[:120],
            allowed=", ".join(sorted(known)),
            hint=", ".join(f"{unknown[0]} belongs in [campaign.{place}]" for place in places),
        )
    kind = head.get("kind", DEFAULT_KIND)
    if kind not in kind_names():
        raise InputError(
            "unknown kind of campaign",
            code="campaign.kind",
            where=str(path),
            got=str(kind)[:60],
            allowed=", ".join(kind_names()),
        )
    return Campaign(
        name=require_name(head.get("name"), "campaign.name"),
        machine=require_name(head.get("machine"), "campaign.machine"),
        kind=kind,
        started=stated.iso_time(head.get("started", ""), "campaign.started", str(path)),
        machine_geometry=stated.table(
            head.get("machine_geometry", {}), "campaign.machine_geometry", kind_named(kind), str(path)
        ),
        instrument=stated.instrument(head.get("instrument", {}), kind_named(kind), str(path)),
    )


def entry_from(told: Any, number: int, path: Path) -> FolderEntry:
    """Return one ``[[run]]``, the ``number``-th of the file ``path``, checked."""
    where = f"{path} run {number}"
    if not isinstance(told, dict):
        raise InputError("a run must be a table", code="campaign.run", where=where)
    unknown = sorted(set(told) - RUN_KEYS)
    if unknown:
        raise InputError(
            "unknown setting of a run",
            code="campaign.run",
            where=where,
            got=", ".join(unknown[:5]),
            allowed=", ".join(sorted(RUN_KEYS)),
        )
    signals = told.get("signals", [])
    names = [signals] if isinstance(signals, str) else signals
    if not isinstance(names, list):
        raise InputError("signals must be a file or a list", code="campaign.run", where=where)
    return FolderEntry(
        run_id=require_name(told.get("id"), f"id of run {number}"),
        file=inside(path.parent, told.get("file"), where),
        signals=tuple(inside(path.parent, name, where) for name in names),
        stated=told,
    )


def _read_entry(entry: FolderEntry, campaign: Campaign, *, house: bool = False) -> tuple[list[Run], list[RejectedRows]]:
    """Return what one file holds; ``house``: it is a foreign table in the house's columns already."""
    suffix = entry.file.suffix.lower()
    rate = entry.stated.get("sample_rate_hz", campaign.instrument.get("sample_rate_hz"))
    if rate is not None:
        rate = stated.positive(rate, "sample_rate_hz", str(entry.file))
    if suffix == ".b5r":
        runs = [_completed(run, entry, f"{entry.run_id}-{run.meta.run_id}") for run in read_b5r(entry.file).runs]
        return runs, []
    if suffix == ".json":
        traces = read_trace_json(entry.file, sample_rate_hz=rate)
        alone = len(traces) == 1
        runs = [_completed(t, entry, entry.run_id if alone else f"{entry.run_id}-{t.meta.run_id}") for t in traces]
        return [_with_programmed_angles(run) for run in runs], []
    kind = kind_named(campaign.kind)
    checked = _checked(entry, kind)
    kind.require_condition(checked.get("condition", {}), str(entry.file))
    reader = kind.reader_of(entry.file)
    if reader is not None:
        runs, rows = reader(entry.file, campaign, checked)
        done = [_completed(r, entry, f"{entry.run_id}-{r.meta.run_id}", by_reader=True) for r in runs]
        kept = [RejectedRows(done[0].meta.run_id, str(entry.file), rows)] if rows else []
        return [kind.completed(run, campaign) for run in done], kept
    try:
        return _read_table(entry, campaign)
    except InputError as error:
        if house or error.code not in ("columns.missing", "table.malformed"):
            raise
        with house_file(entry.file, kind, entry.stated, campaign.instrument.get("columns", {}), error) as lone:
            runs, kept = _read_entry(replace(entry, file=lone), campaign, house=True)
        return [replace(run, source=str(entry.file)) for run in runs], kept


def _checked(entry: FolderEntry, kind: Kind) -> dict[str, Any]:
    """Return what is stated of a run with what readers compute with checked."""
    told, where = dict(entry.stated), str(entry.file)
    for name in _NUMBERS:
        if name in told:
            told[name] = stated.positive(told[name], name, where)
    if "repeat" in told:
        told["repeat"] = stated.count(told["repeat"], "repeat", where)
    if "condition" in told:
        told["condition"] = stated.condition(told["condition"], kind, where)
    return told


def _read_table(entry: FolderEntry, campaign: Campaign) -> tuple[list[Run], list[RejectedRows]]:
    columns, rejects = read_columns(entry.file, campaign.kind)
    gaps = np.diff(columns["t_s"])
    typical = float(np.median(gaps)) if gaps.size else 0.0
    bare = Run(
        meta=RunMeta(
            run_id=entry.run_id, kind=campaign.kind, sample_rate_hz=1.0 / typical if typical > 0 else float("nan")
        ),
        samples=columns,
        source=str(entry.file),
    )
    rejected = [RejectedRows(entry.run_id, str(entry.file), rejects)] if rejects else []
    run = _completed(bare, entry, entry.run_id)
    return [kind_named(campaign.kind).completed(run, campaign)], rejected


def _completed(run: Run, entry: FolderEntry, run_id: str, *, by_reader: bool = False) -> Run:
    """Return the run with what the campaign file states; a contradiction is a finding.

    ``by_reader``: a reader of the kind made it, and has told directions and counted repeats.
    """
    told, meta, where = entry.stated, run.meta, str(entry.file)
    findings = list(run.findings)
    changes: dict[str, Any] = {"run_id": run_id}
    direction = _direction(told, meta, entry, by_reader=by_reader)
    if kind_named(meta.kind).goes_round and direction is not None:
        plane, way = _plane(told, meta, direction, entry)
        changes |= {"plane": plane, "direction": way}
        if way != direction and "angle_deg" in run.samples:
            # Told from the other axis.
            run = replace(run, samples=dict(run.samples) | {"angle_deg": 90.0 - run.samples["angle_deg"]})
    for name in _NUMBERS:
        read = getattr(meta, name)
        value = stated.positive(told[name], name, where) if name in told else None
        if value is not None and read is not None and abs(value - read) > 1e-6 * read:
            findings.append(
                Finding(
                    "campaign.contradiction",
                    "warning",
                    f"campaign.toml states {name} {value:g}, the file {read:g}; the file is used",
                    {f"told_{name}": value, f"read_{name}": read},
                )
            )
        elif read is None:
            changes[name] = value
    if "repeat" in told and not by_reader:
        changes["repeat"] = stated.count(told["repeat"], "repeat", where)
    if "correction" in told:
        changes["correction"] = stated.correction(told["correction"], "correction", where)
    if changes.get("correction") == MIXED_CORRECTION:
        text = "a correction was in force during a part of the run only: it shows neither way"
        findings.append(Finding("correction.mixed", "error", text))
    changes["setup"] = require_name(told.get("setup", meta.setup), "setup")
    if "started" in told:
        changes["started"] = stated.iso_time(told["started"], "started", where)
    changes["condition"] = dict(meta.condition) | stated.condition(
        told.get("condition", {}), kind_named(meta.kind), where
    )
    changes["covariates"] = dict(meta.covariates) | stated.covariates(told.get("covariates", {}), where)
    return replace(run, meta=replace(meta, **changes), findings=tuple(findings))


def _direction(of_run: Mapping[str, Any], meta: RunMeta, entry: FolderEntry, *, by_reader: bool) -> Direction | None:
    told = of_run.get("direction", meta.direction)
    if told is None and not kind_named(meta.kind).goes_round:
        return None
    if told not in ("CCW", "CW"):
        raise InputError(
            "the run does not say its direction",
            code="run.direction",
            where=str(entry.file),
            got=str(told)[:40],
            allowed="CCW or CW",
            hint='add direction = "CCW" to the run in campaign.toml',
        )
    if meta.direction is not None and (by_reader or entry.file.suffix.lower() == ".b5r"):
        return meta.direction
    return cast(Direction, told)


def _plane(told: Mapping[str, Any], meta: RunMeta, direction: Direction, entry: FolderEntry) -> tuple[Any, Direction]:
    if meta.plane is not None:
        return meta.plane, direction
    if "plane" not in told:
        raise InputError("the run does not say its plane", code="run.plane", where=str(entry.file))
    return standard_plane(str(told["plane"]), direction)


def _with_programmed_angles(run: Run) -> Run:
    """Give a trace the angles of its programmed feed: the file itself has none."""
    meta = run.meta
    if not meta.radius_mm or not meta.feed_mm_min:
        raise InputError(
            "a trace needs radius_mm and feed_mm_min in campaign.toml", code="trace.condition", where=run.source
        )
    speed_deg_s = np.degrees(meta.feed_mm_min / 60.0 / meta.radius_mm)
    sign = 1.0 if meta.direction == "CCW" else -1.0
    finding = Finding(
        "angle.programmed", "warning", "the file has no angles; they are computed from the programmed feed"
    )
    samples = dict(run.samples) | {"angle_deg": sign * speed_deg_s * run.samples["t_s"]}
    return replace(run, samples=samples, findings=(*run.findings, finding))


def inside(folder: Path, name: object, where: str) -> Path:
    """Return the path of a file that a campaign names, refused where it leaves the folder."""
    if not isinstance(name, str) or not name or "\x00" in name:
        raise InputError("a run must name its file", code="campaign.file", where=where)
    # Not Path.resolve, which a link that leads to itself ends.
    path = Path(os.path.realpath(folder / name))
    if not path.is_relative_to(folder.resolve()):
        raise InputError(
            "a file lies outside the campaign folder",
            code="campaign.escape",
            where=where,
            got=name[:120],
            allowed="paths inside the folder",
        )
    if path.exists() and not (path.is_file() or path.is_dir()):
        # A pipe that nobody writes into would be waited for for ever.
        raise InputError("a file of the campaign is a device or a pipe", code="campaign.file", where=where, got=name)
    return path


def write_campaign_file(folder: Path, campaign: Mapping[str, Any], runs: Sequence[Mapping[str, Any]]) -> Path:
    """Write the campaign file of a folder in one step and return its path.

    Args:
        folder: Campaign folder, whose other files are there.
        campaign: The table ``[campaign]``, with its own tables.
        runs: A table ``[[run]]`` each.
    """
    content = {"campaign": campaign, "run": list(runs)}
    return write_toml(folder / "campaign.toml", content, "the campaign file")
