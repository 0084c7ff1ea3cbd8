"""Campaign folders: ``campaign.toml`` and the files it names."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from datetime import date, datetime
from pathlib import Path
from typing import Any, cast

import numpy as np

from dtwin.acquire.b5r import read_b5r
from dtwin.acquire.linear_runs import LASER_SUFFIXES, read_laser_runs, with_pitch
from dtwin.acquire.recovery import signal_findings
from dtwin.acquire.signal_files import read_signals
from dtwin.acquire.sinusoidal_runs import with_bandwidth
from dtwin.acquire.tabular import read_columns
from dtwin.acquire.trace_json import read_trace_json
from dtwin.acquire.xmlsafe import read_bounded
from dtwin.errors import InputError
from dtwin.schema import (
    KINDS,
    Campaign,
    Direction,
    Finding,
    Run,
    RunMeta,
    require_name,
    standard_plane,
)
from dtwin.store import RejectedRows

MAX_TOML_BYTES = 16 * 1024 * 1024
_RUN_KEYS = frozenset(
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
    }
)


@dataclass(frozen=True)
class FolderEntry:
    """One ``[[run]]`` of a campaign file, checked but not yet read.

    Attributes
    ----------
    run_id : str
        As stated; a ``.b5r`` becomes ``id-ccw`` and ``id-cw``.
    file : Path
        Samples of the reference instrument.
    signals : tuple of Path
        High-rate signal files.
    stated : dict
        The entry as written.
    """

    run_id: str
    file: Path
    signals: tuple[Path, ...]
    stated: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class CampaignFolder:
    """A campaign and its runs, readable one by one.

    Attributes
    ----------
    campaign : Campaign
        The ``[campaign]`` table.
    entries : tuple of FolderEntry
        One per ``[[run]]``.
    """

    campaign: Campaign
    entries: tuple[FolderEntry, ...]

    def read(self, entry: FolderEntry) -> tuple[list[Run], list[RejectedRows]]:
        """Read the runs of one entry.

        Parameters
        ----------
        entry : FolderEntry
            One of ``entries``.

        Returns
        -------
        runs, rejected : tuple
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
        noticed = tuple(f for path in entry.signals for f in signal_findings(path))
        complete = [
            replace(r, signals=by_direction[r.meta.run_id], findings=(*r.findings, *noticed))
            for r in runs
        ]
        return complete, rejected

    def __iter__(self) -> Iterator[tuple[list[Run], list[RejectedRows]]]:
        return (self.read(entry) for entry in self.entries)


def open_campaign(folder: Path) -> CampaignFolder:
    """Read and check ``campaign.toml`` without reading the measurements.

    Parameters
    ----------
    folder : Path
        The campaign folder, or the toml itself.

    Raises
    ------
    InputError
        With the place of the first thing that is wrong.
    """
    path = folder / "campaign.toml" if folder.is_dir() else folder
    if folder.is_dir() and not path.exists():
        raise InputError(
            "this folder is no campaign: it has no campaign.toml", code="file.missing",
            where=str(folder),
            hint="name a folder that dtwin record or dtwin simulate made, or a .b5r file; "
            "your own: docs/how-to/ingest-your-own.md",
        )  # fmt: skip
    try:
        document = tomllib.loads(read_bounded(path, MAX_TOML_BYTES).decode("utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(
            "campaign.toml is not readable", code="campaign.toml", where=str(path), got=str(error)
        ) from error
    head = document.get("campaign")
    stated_runs = document.get("run")
    if not isinstance(head, dict) or not isinstance(stated_runs, list) or not stated_runs:
        raise InputError(
            "campaign.toml needs a [campaign] table and at least one [[run]]",
            code="campaign.toml",
            where=str(path),
        )
    campaign = _campaign(head, path)
    entries = [_entry(e, n, path) for n, e in enumerate(stated_runs, start=1)]
    ids = [entry.run_id for entry in entries]
    twice = sorted({i for i in ids if ids.count(i) > 1}) if len(set(ids)) < len(ids) else []
    if twice:
        raise InputError(
            "a run id occurs twice",
            code="ingest.duplicate_run",
            where=str(path),
            got=", ".join(twice[:10]),
        )
    return CampaignFolder(campaign, tuple(entries))


def _campaign(head: Mapping[str, Any], path: Path) -> Campaign:
    kind = head.get("kind", "circular")
    if kind not in KINDS:
        raise InputError(
            "unknown kind of campaign",
            code="campaign.kind",
            where=str(path),
            got=str(kind)[:60],
            allowed=", ".join(KINDS),
        )
    return Campaign(
        name=require_name(head.get("name"), "campaign.name"),
        machine=require_name(head.get("machine"), "campaign.machine"),
        kind=kind,
        started=_iso(head.get("started", "")),
        machine_geometry=_table(head, "machine_geometry", path),
        instrument=_table(head, "instrument", path),
    )


def _entry(stated: Any, number: int, path: Path) -> FolderEntry:
    where = f"{path} run {number}"
    if not isinstance(stated, dict):
        raise InputError("a run must be a table", code="campaign.run", where=where)
    unknown = sorted(set(stated) - _RUN_KEYS)
    if unknown:
        raise InputError(
            "unknown setting of a run",
            code="campaign.run",
            where=where,
            got=", ".join(unknown[:5]),
            allowed=", ".join(sorted(_RUN_KEYS)),
        )
    signals = stated.get("signals", [])
    names = [signals] if isinstance(signals, str) else signals
    if not isinstance(names, list):
        raise InputError("signals must be a file or a list", code="campaign.run", where=where)
    return FolderEntry(
        run_id=require_name(stated.get("id"), f"id of run {number}"),
        file=_inside(path.parent, stated.get("file"), where),
        signals=tuple(_inside(path.parent, name, where) for name in names),
        stated=stated,
    )


def _read_entry(entry: FolderEntry, campaign: Campaign) -> tuple[list[Run], list[RejectedRows]]:
    suffix = entry.file.suffix.lower()
    if suffix == ".b5r":
        runs = [
            _completed(run, entry, f"{entry.run_id}-{run.meta.run_id}")
            for run in read_b5r(entry.file).runs
        ]
        return runs, []
    if suffix == ".json":
        rate = entry.stated.get("sample_rate_hz") or campaign.instrument.get("sample_rate_hz")
        traces = read_trace_json(entry.file, sample_rate_hz=rate)
        alone = len(traces) == 1
        runs = [
            _completed(t, entry, entry.run_id if alone else f"{entry.run_id}-{t.meta.run_id}")
            for t in traces
        ]
        return [_with_programmed_angles(run) for run in runs], []
    if suffix in LASER_SUFFIXES and campaign.kind == "linear":
        runs, rows = read_laser_runs(entry.file, campaign, entry.stated)
        done = [_completed(r, entry, f"{entry.run_id}-{r.meta.run_id}", count=True) for r in runs]
        kept = [RejectedRows(done[0].meta.run_id, str(entry.file), rows)] if rows else []
        return [with_pitch(run, campaign) for run in done], kept
    return _read_table(entry, campaign)


def _read_table(entry: FolderEntry, campaign: Campaign) -> tuple[list[Run], list[RejectedRows]]:
    columns, rejects = read_columns(entry.file, campaign.kind)
    gaps = np.diff(columns["t_s"])
    typical = float(np.median(gaps)) if gaps.size else 0.0
    bare = Run(
        meta=RunMeta(
            run_id=entry.run_id,
            kind=campaign.kind,
            sample_rate_hz=1.0 / typical if typical > 0 else float("nan"),
        ),
        samples=columns,
        source=str(entry.file),
    )
    rejected = [RejectedRows(entry.run_id, str(entry.file), rejects)] if rejects else []
    run = _completed(bare, entry, entry.run_id)
    limits = {"linear": with_pitch, "sinusoidal": with_bandwidth}.get(campaign.kind)
    return [run if limits is None else limits(run, campaign)], rejected


def _completed(run: Run, entry: FolderEntry, run_id: str, *, count: bool = False) -> Run:
    """Return the run with what the campaign file states; a contradiction is a finding."""
    stated, meta = entry.stated, run.meta
    findings = list(run.findings)
    changes: dict[str, Any] = {"run_id": run_id}
    direction = _direction(stated, meta, entry)
    if meta.kind == "circular" and direction is not None:
        plane, direction = _plane(stated, meta, direction, entry)
        changes |= {"plane": plane, "direction": direction}
    for name in ("radius_mm", "feed_mm_min"):
        told, read = _positive(stated, name, entry), getattr(meta, name)
        if told is not None and read is not None and abs(told - read) > 1e-6 * read:
            findings.append(
                Finding(
                    "campaign.contradiction",
                    "warning",
                    f"campaign.toml states {name} {told:g}, the file {read:g}; the file is used",
                    {f"told_{name}": told, f"read_{name}": read},
                )
            )
        elif read is None:
            changes[name] = told
    changes["repeat"] = meta.repeat if count else int(stated.get("repeat", meta.repeat))
    changes["setup"] = require_name(stated.get("setup", meta.setup), "setup")
    changes["started"] = _iso(stated.get("started", meta.started))
    changes["condition"] = dict(meta.condition) | dict(stated.get("condition", {}))
    changes["covariates"] = dict(meta.covariates) | _numbers(stated.get("covariates", {}), entry)
    return replace(run, meta=replace(meta, **changes), findings=tuple(findings))


def _direction(stated: Mapping[str, Any], meta: RunMeta, entry: FolderEntry) -> Direction | None:
    told = stated.get("direction", meta.direction)
    if told is None and meta.kind != "circular":
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
    if meta.direction is not None and entry.file.suffix.lower() == ".b5r":
        return meta.direction
    return cast(Direction, told)


def _plane(
    stated: Mapping[str, Any], meta: RunMeta, direction: Direction, entry: FolderEntry
) -> tuple[Any, Direction]:
    if meta.plane is not None:
        return meta.plane, direction
    if "plane" not in stated:
        raise InputError("the run does not say its plane", code="run.plane", where=str(entry.file))
    return standard_plane(str(stated["plane"]), direction)


def _with_programmed_angles(run: Run) -> Run:
    """Give a trace the angles of its programmed feed: the file itself has none."""
    meta = run.meta
    if not meta.radius_mm or not meta.feed_mm_min:
        raise InputError(
            "a trace needs radius_mm and feed_mm_min in campaign.toml",
            code="trace.condition",
            where=run.source,
        )
    speed_deg_s = np.degrees(meta.feed_mm_min / 60.0 / meta.radius_mm)
    sign = 1.0 if meta.direction == "CCW" else -1.0
    finding = Finding(
        "angle.programmed",
        "warning",
        "the file has no angles; they are computed from the programmed feed",
    )
    samples = dict(run.samples) | {"angle_deg": sign * speed_deg_s * run.samples["t_s"]}
    return replace(run, samples=samples, findings=(*run.findings, finding))


def _inside(folder: Path, name: object, where: str) -> Path:
    if not isinstance(name, str) or not name or "\x00" in name:
        raise InputError("a run must name its file", code="campaign.file", where=where)
    path = (folder / name).resolve()
    if not path.is_relative_to(folder.resolve()):
        raise InputError(
            "a file lies outside the campaign folder",
            code="campaign.escape",
            where=where,
            got=name[:120],
            allowed="paths inside the folder",
        )
    return path


def _positive(stated: Mapping[str, Any], name: str, entry: FolderEntry) -> float | None:
    value = stated.get(name)
    if value is None:
        return None
    if not isinstance(value, int | float) or not 0 < value < 1e7:
        raise InputError(
            f"{name} must be a positive number",
            code="campaign.run",
            where=str(entry.file),
            got=repr(value)[:40],
        )
    return float(value)


def _numbers(covariates: Any, entry: FolderEntry) -> dict[str, float]:
    good = isinstance(covariates, dict) and all(
        isinstance(v, int | float) and np.isfinite(v) for v in covariates.values()
    )
    if not good:
        raise InputError(
            "covariates must be finite numbers", code="campaign.covariates", where=str(entry.file)
        )
    return {name: float(value) for name, value in covariates.items()}


def _table(head: Mapping[str, Any], name: str, path: Path) -> dict[str, Any]:
    value = head.get(name, {})
    if not isinstance(value, dict):
        raise InputError(
            f"[campaign.{name}] must be a table", code="campaign.toml", where=str(path)
        )
    return value


def _iso(value: object) -> str:
    return value.isoformat() if isinstance(value, datetime | date) else str(value)
