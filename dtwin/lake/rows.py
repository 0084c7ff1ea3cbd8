"""Rows of the table ``runs``: from a run and back."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from dtwin.errors import StoreError
from dtwin.local_time import local_time
from dtwin.schema import Campaign, Finding, Run, RunMeta

_Row = TypeVar("_Row", bound=Mapping[str, Any])
_INCOMPLETE = "recording.incomplete"
RUN_SCHEMA = pa.schema(
    [
        *(
            (name, pa.string())
            for name in (
                "campaign",
                "machine",
                "kind",
                "run_id",
                "plane",
                "direction",
                "setup",
                "started",
                "status",
                "source",
                "content_sha256",
                "samples_sha256",
                "signals_sha256",
                "row_sha256",
                "samples_file",
                "signals_json",
                "condition_json",
                "covariates_json",
                "vendor_json",
                "findings_json",
                "geometry_json",
                "instrument_json",
                "ingested",
                "correction",
            )
        ),
        *((name, pa.float64()) for name in ("radius_mm", "feed_mm_min", "sample_rate_hz")),
        *((name, pa.int64()) for name in ("repeat", "n_samples", "window_start", "window_end", "n_errors")),
    ]
)


AMENDMENT_SCHEMA = pa.schema(
    [
        *(
            (name, pa.string())
            for name in ("campaign", "run_id", "who", "when", "because", "changes_json", "row_sha256")
        ),
        ("version", pa.int64()),
    ]
)
# Of a row of ``runs``: what a campaign file states of the campaign as a whole.
OF_CAMPAIGN = ("machine", "kind", "geometry_json", "instrument_json")
# What may be stated anew by an amendment, besides findings and whether the run is left out.
_OF_RUN = (
    "plane",
    "direction",
    "radius_mm",
    "feed_mm_min",
    "repeat",
    "setup",
    "started",
    "condition_json",
    "covariates_json",
)
_CONTENT = (
    *OF_CAMPAIGN,
    *_OF_RUN,
    "campaign",
    "run_id",
    "sample_rate_hz",
    "window_start",
    "window_end",
    "correction",
    "samples_sha256",
    "signals_sha256",
)


_PIECE = 65_536


def columns_sha256(columns: Mapping[str, NDArray[Any]]) -> str:
    """Return a hash of columns: names, types and values."""
    digest = hashlib.sha256()
    for name in sorted(columns):
        values = columns[name]
        digest.update(f"{name} {values.dtype.str} {values.size};".encode())
        if values.dtype == object:
            # As one JSON array, in pieces that are small in memory.
            parts = (json.dumps(values[n : n + _PIECE].tolist())[1:-1] for n in range(0, values.size, _PIECE))
            for number, part in enumerate(parts):
                digest.update((", " if number else "[").encode() + part.encode())
            digest.update(b"]" if values.size else b"[]")
        else:
            digest.update(np.ascontiguousarray(values).data.cast("B"))
    return digest.hexdigest()


def sealed(rows: Sequence[Mapping[str, Any]], schema: pa.Schema) -> pa.Table:
    """Return rows as a table; ``row_sha256`` of each is the hash of everything else in it."""
    # First into the table's types: what is hashed is what will be read.
    plain = pa.Table.from_pylist(rows, schema=schema).to_pylist()
    return pa.Table.from_pylist([{**r, "row_sha256": _seal(r)} for r in plain], schema=schema)


def unsealed(rows: pa.Table, schema: pa.Schema, where: str) -> list[dict[str, Any]]:
    """Return the rows of a table after comparing its columns and every row's hash."""
    unpacked: list[dict[str, Any]] = rows.to_pylist()
    names = {field.name: field.type for field in schema}
    if unpacked and {field.name: field.type for field in rows.schema} != names:
        strange = sorted(set(rows.schema.names) ^ set(names)) or ["types"]
        raise StoreError(
            "the rows were written by another version of dtwin, or are damaged",
            code="store.schema",
            where=where,
            got=", ".join(strange)[:200],
            hint="restore the folder from a backup, or ingest the sources into a new DTWIN_HOME",
        )
    for row in unpacked:
        if _seal(row) != row["row_sha256"]:
            raise StoreError(
                "a row is not what was written",
                code="store.damaged",
                where=f"{where} {row['campaign']} {row['run_id']}"[:200],
                hint="restore the folder from a backup",
            )
    return unpacked


def _seal(row: Mapping[str, Any]) -> str:
    return _hash({name: value for name, value in row.items() if name != "row_sha256"})


def _hash(fields: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(fields, sort_keys=True).encode()).hexdigest()


def run_row(campaign: Campaign, run: Run) -> dict[str, Any]:
    """Return the row of a run, complete but for the files: samples, signals and its own hash.

    ``content_sha256`` is of everything that was measured and stated, whatever file it came in:
    values, clocks, window, condition, machine, geometry and instrument.
    """
    meta = run.meta
    row: dict[str, Any] = {
        "campaign": campaign.name,
        "machine": campaign.machine,
        "kind": campaign.kind,
        "run_id": meta.run_id,
        "plane": meta.plane,
        "direction": meta.direction,
        "setup": meta.setup,
        "started": meta.started or campaign.started,
        "status": "incomplete" if any(f.code == _INCOMPLETE for f in run.findings) else "complete",
        "source": run.source,
        "samples_sha256": columns_sha256(run.samples),
        "condition_json": json.dumps(dict(meta.condition)),
        "covariates_json": json.dumps(dict(meta.covariates)),
        "vendor_json": json.dumps(dict(meta.vendor)),
        **findings_fields(run.findings),
        "geometry_json": json.dumps(dict(campaign.machine_geometry), default=str),
        "instrument_json": json.dumps(dict(campaign.instrument), default=str),
        "ingested": datetime.now(UTC).isoformat(timespec="seconds"),
        "correction": meta.correction,
        "radius_mm": None if meta.radius_mm is None else float(meta.radius_mm),
        "feed_mm_min": None if meta.feed_mm_min is None else float(meta.feed_mm_min),
        "sample_rate_hz": float(meta.sample_rate_hz),
        "repeat": int(meta.repeat),
        "n_samples": run.n_samples,
        "window_start": None if run.window is None else int(run.window[0]),
        "window_end": None if run.window is None else int(run.window[1]),
    }
    signals = [(g.name, float(g.rate_hz), float(g.start_s), columns_sha256(g.columns)) for g in run.signals]
    row["signals_sha256"] = _hash({"signals": sorted(signals)})
    return row | {"content_sha256": _hash({name: row[name] for name in _CONTENT})}


def findings_fields(findings: Sequence[Finding]) -> dict[str, Any]:
    """Return the fields of a row that say what is noteworthy or wrong with the run."""
    return {
        "findings_json": json.dumps([finding.as_dict() for finding in findings]),
        "n_errors": sum(finding.severity == "error" for finding in findings),
    }


def differences(stored: Mapping[str, Any], stated: Mapping[str, Any]) -> list[str]:
    """Return in words what is stated otherwise in two rows of one run, ``was -> is``.

    Values that were measured are compared by their hashes.
    """
    told = []
    for name in (*OF_CAMPAIGN, *_OF_RUN, "sample_rate_hz", "window_start", "window_end", "correction"):
        was, now = stored[name], stated[name]
        if name.endswith("_json"):
            before, after = json.loads(was), json.loads(now)
            told += [
                f"{name.removesuffix('_json')}.{key}: {before.get(key)} -> {after.get(key)}"
                for key in sorted({*before, *after})
                if before.get(key) != after.get(key)
            ]
        elif name == "started" and local_time(was or "") == local_time(now or ""):
            continue
        elif was != now and not (was is None and now != now):
            told.append(f"{name}: {was} -> {now}")
    measured = ("samples", "signals")
    told += [f"the {w}" for w in measured if stored[f"{w}_sha256"] != stated[f"{w}_sha256"]]
    return told


def amended(rows: Sequence[Mapping[str, Any]], amendments: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return rows as they are stated now, each with its amendments.

    ``amendments`` of a row are its records, the oldest first; ``metadata_version`` is the newest
    one's, 0 as ingested; ``left_out`` says why the run is left out, None when it is not. What is
    stated otherwise is another content: ``content_sha256`` covers it, and ``raw_sha256`` is the
    hash that was ingested.
    """
    by_run: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for record in sorted(amendments, key=lambda r: r["version"]):
        by_run.setdefault((record["campaign"], record["run_id"]), []).append(record)
    after = []
    for row in rows:
        records = by_run.get((row["campaign"], row["run_id"]), [])
        changes: dict[str, Any] = {}
        left_out = None
        for record in records:
            changed = json.loads(record["changes_json"])
            if "left_out" in changed:
                left_out = record["because"] if changed.pop("left_out") else None
            changes |= changed
        stated = {name: value for name, value in changes.items() if row[name] != value}
        now = {
            **row,
            **changes,
            # As times without a zone are told, so that order and days of tests are those of one clock.
            "started": local_time(changes.get("started", row["started"]) or ""),
            "raw_sha256": row["content_sha256"],
            "amendments": records,
            "metadata_version": records[-1]["version"] if records else 0,
            "left_out": left_out,
        }
        if any(name in stated for name in (*OF_CAMPAIGN, *_OF_RUN)):
            now["content_sha256"] = _hash({"raw": row["content_sha256"], "stated": stated})
        after.append(now)
    return after


def by_campaign(rows: Iterable[_Row]) -> dict[str, list[_Row]]:
    """Return rows of runs by their campaign."""
    campaigns: dict[str, list[_Row]] = {}
    for row in rows:
        campaigns.setdefault(str(row["campaign"]), []).append(row)
    return campaigns


def moved_in(rows: Iterable[Mapping[str, Any]]) -> tuple[str, ...]:
    """Return the planes of a campaign, else the conditions that name its axes, in order, of the rows of its runs."""
    return tuple(sorted({str(row["plane"] or row["condition_json"]) for row in rows if not row["left_out"]}))


def campaign_of(rows: Sequence[Mapping[str, Any]]) -> Campaign:
    """Return what the rows of the runs of a campaign say of it; all of them, at least one."""
    first = rows[0]
    geometry = json.loads(first["geometry_json"])
    if any(row["correction"] for row in rows):
        geometry["corrected"] = True
    return Campaign(
        name=first["campaign"],
        machine=first["machine"],
        kind=first["kind"],
        started=first["started"],
        machine_geometry=geometry,
        instrument=json.loads(first["instrument_json"]),
    )


def meta_of(row: Mapping[str, Any]) -> RunMeta:
    """Return what a row says of its run."""
    meta = RunMeta(
        run_id=row["run_id"],
        kind=row["kind"],
        plane=row["plane"],
        direction=row["direction"],
        radius_mm=row["radius_mm"],
        feed_mm_min=row["feed_mm_min"],
        repeat=row["repeat"],
        setup=row["setup"],
        started=row["started"],
        sample_rate_hz=row["sample_rate_hz"],
        correction=row["correction"],
    )
    return replace(
        meta,
        condition=json.loads(row["condition_json"]),
        covariates=json.loads(row["covariates_json"]),
        vendor=json.loads(row["vendor_json"]),
    )
