"""Measure, ingest, compute features."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dtwin.acquire.ingest import IngestReport
from dtwin.acquire.ingest import ingest as ingest_path
from dtwin.acquire.runner import CampaignRun, run_campaign
from dtwin.acquire.virtual import VirtualCobotBench
from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.features.windows import WindowContract, batch_features
from dtwin.lake.parquet import table_of
from dtwin.lake.store import Lake
from dtwin.plan import Plan
from dtwin.progress import Progress, silent
from dtwin.train.inputs import BAND_HZ, HOP, WINDOW_FEATURES, WINDOW_SAMPLES


@dataclass(frozen=True)
class FeatureReport:
    """What the features of a campaign are.

    ``runs``, ``windows``: runs whose accelerometers hold a window at least, and windows in all.
    ``contract``: window and features; None without such a run.
    ``not_finite``, ``constant``: windows of a channel that hold no usable signal.
    """

    campaign: str
    runs: int
    windows: int
    contract: WindowContract | None
    not_finite: int
    constant: int
    version: int


def simulate(plan: Plan, out: Path, *, seed: int = 0, progress: Progress = silent) -> CampaignRun:
    """Measure a plan on the virtual cobot, on the machine clock."""
    return run_campaign(plan, VirtualCobotBench(seed), out, progress)


def ingest(path: Path, home: Home, progress: Progress = silent, told: Mapping[str, Any] | None = None) -> IngestReport:
    """Bring a campaign folder, a ball-bar file or a table that lies alone into the lake."""
    return ingest_path(path, Lake(home.lake), progress, told)


def compute_features(home: Home, campaign: str, progress: Progress = silent) -> FeatureReport:
    """Compute the signal features of every run and keep them in the lake.

    Features of a run are written once per window contract and content; a repeated call adds
    nothing.

    Raises ``InputError`` when the campaign is unknown.
    """
    lake = Lake(home.lake)
    lake.campaign(campaign)
    rows = lake.runs(campaign)
    parts: list[Mapping[str, object]] = []
    keys: list[str] = []
    contract: WindowContract | None = None
    bad = constant = 0
    for done, row in enumerate(rows, start=1):
        run = lake.load(row)
        group = next((g for g in run.signals if g.name == "accelerometers"), None)
        mine = None if group is None else _contract_for(group.rate_hz, tuple(group.columns))
        # A run that is shorter than a window has no features.
        if group is not None and mine is not None and mine.channels and group.n_samples >= mine.n_samples:
            if contract is not None and mine != contract:
                raise InputError(
                    "runs of the campaign have different channels or rates",
                    code="features.contract",
                    where=run.meta.run_id,
                )
            contract = mine
            block = np.stack([group.columns[name] for name in contract.channels])
            features = batch_features(block, contract, group.start_s)
            flat = features.values.reshape(len(features.values), -1)
            bad += int(np.count_nonzero(features.codes == 2))
            constant += int(np.count_nonzero(features.codes == 1))
            parts.append({"run": row["run_id"], "end_s": features.end_s, "values": flat})
            keys.append(row["content_sha256"])
        progress(done, len(rows), row["run_id"])
    if contract is None:
        return FeatureReport(campaign, 0, 0, None, 0, 0, lake.tables["features"].version())
    counts = [len(part["end_s"]) for part in parts]  # type: ignore[arg-type]
    columns: dict[str, Any] = {
        "campaign": [campaign] * sum(counts),
        "run_id": [str(p["run"]) for p, n in zip(parts, counts, strict=True) for _ in range(n)],
        "contract_sha256": [_contract_sha256(contract)] * sum(counts),
        "end_s": np.concatenate([np.asarray(p["end_s"]) for p in parts]),
    }
    values = np.concatenate([np.asarray(p["values"]) for p in parts])
    columns |= {name: values[:, i] for i, name in enumerate(contract.columns)}
    key = _contract_sha256(contract) + "".join(keys)
    version = lake.write_table("features", key, table_of(columns))
    return FeatureReport(campaign, len(parts), sum(counts), contract, bad, constant, version)


def _contract_for(rate_hz: float, columns: tuple[str, ...]) -> WindowContract:
    """Return the window contract for accelerometers of a rate.

    ``columns``: columns of the signal group; those in g are used.
    """
    return WindowContract(
        rate_hz=rate_hz,
        n_samples=WINDOW_SAMPLES,
        hop=HOP,
        channels=tuple(name for name in columns if name.endswith("_g")),
        features=WINDOW_FEATURES,
        band_hz=BAND_HZ,
        detrend="mean",
    )


def _contract_sha256(contract: WindowContract) -> str:
    """Return a hash of a window contract."""
    return hashlib.sha256(json.dumps(contract.to_dict(), sort_keys=True).encode()).hexdigest()
