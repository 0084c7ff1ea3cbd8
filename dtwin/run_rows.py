"""Rows of the table ``runs``: from a run and back."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pyarrow as pa

from dtwin.schema import Campaign, Run, RunMeta

INCOMPLETE = "recording.incomplete"
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
                "samples_file",
                "signals_json",
                "condition_json",
                "covariates_json",
                "vendor_json",
                "findings_json",
                "geometry_json",
                "instrument_json",
                "ingested",
            )
        ),
        *((name, pa.float64()) for name in ("radius_mm", "feed_mm_min", "sample_rate_hz")),
        *(
            (name, pa.int64())
            for name in (
                "repeat",
                "n_samples",
                "window_start",
                "window_end",
                "n_errors",
            )
        ),
    ]
)


def content_sha256(run: Run) -> str:
    """Return a hash of everything that was measured and under which condition."""
    digest = hashlib.sha256()
    meta = {k: v for k, v in asdict(run.meta).items() if k != "vendor"}
    digest.update(json.dumps(meta, sort_keys=True, default=str).encode())
    groups = [("samples", run.samples), *((g.name, g.columns) for g in run.signals)]
    for group, columns in groups:
        for name in sorted(columns):
            values = columns[name]
            digest.update(f"{group}/{name}".encode())
            data = (
                json.dumps(values.tolist()).encode()
                if values.dtype == object
                else np.ascontiguousarray(values).data.cast("B")
            )
            digest.update(data)
    return digest.hexdigest()


def run_row(
    campaign: Campaign,
    run: Run,
    sha: str,
    sample_file: str,
    groups: Sequence[Mapping[str, Any]],
) -> dict[str, Any]:
    """Return the row of a run.

    Parameters
    ----------
    campaign : Campaign
        What it belongs to.
    run : Run
        The run.
    sha : str
        Hash of its content.
    sample_file : str
        Data file of its samples.
    groups : sequence of mapping
        Data files of its signals with their clocks.
    """
    meta = run.meta
    return {
        "campaign": campaign.name,
        "machine": campaign.machine,
        "kind": campaign.kind,
        "run_id": meta.run_id,
        "plane": meta.plane,
        "direction": meta.direction,
        "setup": meta.setup,
        "started": meta.started or campaign.started,
        "status": "incomplete" if any(f.code == INCOMPLETE for f in run.findings) else "complete",
        "source": run.source,
        "content_sha256": sha,
        "samples_file": sample_file,
        "signals_json": json.dumps(list(groups)),
        "condition_json": json.dumps(dict(meta.condition)),
        "covariates_json": json.dumps(dict(meta.covariates)),
        "vendor_json": json.dumps(dict(meta.vendor)),
        "findings_json": json.dumps([finding.as_dict() for finding in run.findings]),
        "geometry_json": json.dumps(dict(campaign.machine_geometry), default=str),
        "instrument_json": json.dumps(dict(campaign.instrument), default=str),
        "ingested": datetime.now(UTC).isoformat(timespec="seconds"),
        "radius_mm": meta.radius_mm,
        "feed_mm_min": meta.feed_mm_min,
        "sample_rate_hz": meta.sample_rate_hz,
        "repeat": meta.repeat,
        "n_samples": run.n_samples,
        "window_start": None if run.window is None else run.window[0],
        "window_end": None if run.window is None else run.window[1],
        "n_errors": sum(finding.severity == "error" for finding in run.findings),
    }


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
    )
    return replace(
        meta,
        condition=json.loads(row["condition_json"]),
        covariates=json.loads(row["covariates_json"]),
        vendor=json.loads(row["vendor_json"]),
    )
