"""Takes over a home that an earlier version of dtwin made, before what it stores was hashed."""

from __future__ import annotations

import hashlib
import json
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from dtwin.atomic import sync
from dtwin.config import Home
from dtwin.documents import write_document
from dtwin.errors import InputError, StoreError
from dtwin.home_file import Bucket
from dtwin.lake.delta import DeltaFiles
from dtwin.lake.parquet import columns_of, read_parquet
from dtwin.lake.rows import RUN_SCHEMA, meta_of
from dtwin.lake.store import Lake, RejectedRows
from dtwin.progress import Progress
from dtwin.schema import Campaign, Finding, Run, SignalGroup
from dtwin.serve.bundle_file import parse_json, read_bytes
from dtwin.serve.interface import mapping
from dtwin.serve.sealed import CHAMPION, SEALED, TRIAL, is_sealed, write_sealed

_BEFORE, _MADE = "lake.before-migration", "lake.migrating"
_LARGEST = 100_000
_DOCUMENT = 50_000_000


@dataclass(frozen=True)
class _Migrated:
    """What was taken over.

    ``documents``: versions of twins and what was stored with them.
    ``machines``: machines whose champion, trial and geometry were sealed as they are.
    ``before``: the lake as it was; None when it was of this version already.
    """

    campaigns: tuple[str, ...]
    n_runs: int
    documents: int
    machines: tuple[str, ...]
    before: Path | None


def migrate(home: Home, progress: Progress) -> _Migrated:
    """Take over lake, twins and machines' folders of an earlier version.

    The lake is written anew beside the old one, which stays. Every run is compared with the hash that
    its ingest stored. Features are not taken over: ``dtwin features`` makes them again. Can be repeated
    after a kill.

    Raises ``StoreError`` when a run is not what was ingested, or something cannot be read or written.
    """
    campaigns, n_runs = _lake(home, progress)
    documents = [path for path in sorted((home.root / "twins").rglob("*.json")) if _sealed_now(path)]
    folders = sorted(path.parent for path in home.bundles.glob("*/machine.json"))
    machines = tuple(folder.name for folder in folders if _seal(folder))
    before = home.root / _BEFORE
    return _Migrated(campaigns, n_runs, len(documents), machines, before if campaigns else None)


def _lake(home: Home, progress: Progress) -> tuple[tuple[str, ...], int]:
    """Write the lake anew, put it in the place of the old one, and return its campaigns and runs."""
    before, made = home.root / _BEFORE, home.root / _MADE
    place = home.lake
    if isinstance(place, Bucket):
        # No version without hashes ever wrote there.
        return (), 0
    if not place.exists() and made.exists() and before.exists():
        # A kill between the two renames.
        made.rename(place)
    if not DeltaFiles(place / "runs").is_earlier():
        return (), 0
    if before.exists():
        raise InputError(
            "a lake was set aside by an earlier migration",
            code="migrate.before",
            where=str(before),
            hint="look which of both is wanted, and move the other one away",
        )
    lake, n_runs, names = Lake(made), 0, []
    rejected = _rejected(place)
    campaigns = _campaigns(place)
    for number, (campaign, rows) in enumerate(campaigns):
        progress(number, len(campaigns), campaign.name)
        runs = [_run(place, row) for row in rows]
        lake.commit(campaign, runs, rejected[campaign.name])
        names.append(campaign.name)
        n_runs += len(runs)
    place.rename(before)
    made.rename(place)
    sync(home.root)
    return tuple(names), n_runs


def _campaigns(root: Path) -> list[tuple[Campaign, list[dict[str, Any]]]]:
    out = []
    by_name: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for row in _rows(root, "runs"):
        by_name[row["campaign"]].append({name: None for name in RUN_SCHEMA.names} | row)
    for name, rows in sorted(by_name.items()):
        ordered = sorted(rows, key=lambda r: (r["started"] or "", r["run_id"]))
        first = ordered[0]
        campaign = Campaign(
            name=name,
            machine=first["machine"],
            kind=first["kind"],
            started=first["started"],
            machine_geometry=json.loads(first["geometry_json"]),
            instrument=json.loads(first["instrument_json"]),
        )
        out.append((campaign, ordered))
    return out


def _rejected(root: Path) -> dict[str, list[RejectedRows]]:
    parts: dict[tuple[str, str, str], list[dict[str, Any]]] = defaultdict(list)
    for row in _rows(root, "rejects"):
        parts[row["campaign"], row["run_id"], row["source"]].append(
            {"row": row["row"], "reason": row["reason"], "values": json.loads(row["values_json"])}
        )
    out: dict[str, list[RejectedRows]] = defaultdict(list)
    for (campaign, run_id, source), rows in parts.items():
        out[campaign].append(RejectedRows(run_id, source, rows))
    return out


def _rows(root: Path, table: str) -> list[dict[str, Any]]:
    files = DeltaFiles(root / table).earlier_files()
    tables = [_read(root / table, name) for name in files]
    return pa.concat_tables(tables, promote_options="permissive").to_pylist() if tables else []


def _read(folder: Path, name: str) -> pa.Table:
    path = folder / name
    if not path.resolve().is_relative_to(folder.resolve()):
        raise StoreError("a data file lies outside its table", code="store.name", where=str(folder), got=name)
    return read_parquet(path)


def _run(root: Path, row: Mapping[str, Any]) -> Run:
    meta = meta_of({**row, "correction": ""})
    groups = json.loads(row["signals_json"])
    run = Run(
        meta=meta,
        samples=columns_of(_read(root / "samples", row["samples_file"])),
        window=None if row["window_start"] is None else (row["window_start"], row["window_end"]),
        signals=tuple(
            SignalGroup(g["group"], g["rate_hz"], columns_of(_read(root / "signals", g["file"])), g["start_s"])
            for g in groups
        ),
        source=row["source"],
        findings=tuple(Finding(**f) for f in json.loads(row["findings_json"])),
    )
    if _content_sha256(run) != row["content_sha256"]:
        raise StoreError(
            "a run is not what was ingested",
            code="store.content",
            where=f"{row['campaign']} {row['run_id']}",
            hint="restore the lake from a backup, or ingest its sources again into a new home",
        )
    return run


def _content_sha256(run: Run) -> str:
    """Return the hash of a run as the earlier version computed it."""
    digest = hashlib.sha256()
    meta = {k: v for k, v in asdict(run.meta).items() if k not in ("vendor", "correction")}
    digest.update(json.dumps(meta, sort_keys=True, default=str).encode())
    for group, columns in [("samples", run.samples), *((g.name, g.columns) for g in run.signals)]:
        for name in sorted(columns):
            values = columns[name]
            digest.update(f"{group}/{name}".encode())
            if values.dtype == object:
                digest.update(json.dumps(values.tolist()).encode())
            else:
                digest.update(np.ascontiguousarray(values).data.cast("B"))
    return digest.hexdigest()


def _sealed_now(path: Path) -> bool:
    """Give a document that has no hash its own; tell whether it had none."""
    document = parse_json(read_bytes(path, _DOCUMENT), path)
    if not isinstance(document, dict) or "sha256" in document:
        return False
    write_document(path, document, "a version of a twin")
    return True


def _seal(folder: Path) -> bool:
    """Seal the files of a machine as they are; tell whether they were not sealed."""
    if is_sealed(folder):
        return False
    for name in SEALED:
        path = folder / name
        if path.exists():
            content = parse_json(read_bytes(path, _LARGEST), path)
            # When a champion was last shown to help was not noted.
            new = {"proved": ""} if name in (CHAMPION, TRIAL) else {}
            write_sealed(folder, name, {**new, **mapping(content, str(path))})
    return True
