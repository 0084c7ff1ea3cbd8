"""Recorded tones, written as a campaign folder."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from dtwin.acquire.campaign_file import write_campaign_file
from dtwin.acquire.signal_files import write_signals
from dtwin.atomic import write_toml
from dtwin.lake.parquet import table_of, write_parquet
from dtwin.machines.turning import AnaloguePath
from dtwin.progress import Progress
from dtwin.schema import Run, RunMeta

# Of probe, encoder and accelerometer.
SAMPLE_HZ = 1000.0
_BANDWIDTH_HZ = 50.0


def write_tone_campaign(
    folder: Path,
    runs: Iterable[Run],
    told: Mapping[str, Any],
    truth: str,
    name: str,
    machine: str,
    shown: tuple[Progress | None, int] = (None, 0),
    *,
    corrected: bool = False,
) -> None:
    """Write tones as a campaign folder; the campaign file comes last.

    ``runs``: the tones; each is written when it comes.
    ``shown``: what to call with (done, total, what), and the total.
    ``corrected``: whether a correction was in force.
    """
    progress, count = shown
    measured = []
    for number, run in enumerate(runs, start=1):
        stem = run.meta.run_id
        write_parquet(folder / f"{stem}.parquet", table_of(run.samples))
        write_signals(folder / f"{stem}.accelerometers.parquet", run.signals[0])
        measured.append(run.meta)
        if progress is not None:
            progress(number, count, stem)
    write_toml(folder / "truth.toml", told, "the truth")
    geometry = {
        "type": "turning",
        "virtual": True,
        "corrected": corrected,
        "truth": truth,
        "z_bandwidth_hz": _BANDWIDTH_HZ,
        "correction_delay_s": AnaloguePath().delay_s,
    }
    head = {
        "name": name,
        "machine": machine,
        "kind": "sinusoidal",
        "machine_geometry": geometry,
        "instrument": {"model": "virtual capacitance probe", "sample_rate_hz": float(SAMPLE_HZ)},
    }
    write_campaign_file(folder, head, [_entry(meta) for meta in measured])


def _entry(meta: RunMeta) -> dict[str, Any]:
    run: dict[str, Any] = {
        "id": meta.run_id,
        "file": f"{meta.run_id}.parquet",
        "signals": f"{meta.run_id}.accelerometers.parquet",
        "repeat": meta.repeat,
        "condition": {
            "axis": "Z",
            "frequency_hz": float(meta.condition["frequency_hz"]),
            "amplitude_um": float(meta.condition["amplitude_um"]),
        },
    }
    return run | ({"covariates": dict(meta.covariates)} if meta.covariates else {})
