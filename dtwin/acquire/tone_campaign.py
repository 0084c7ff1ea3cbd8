"""Recorded tones, written as a campaign folder."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from dtwin.acquire.runner import toml_value
from dtwin.acquire.signal_files import write_signals
from dtwin.atomic import write_text
from dtwin.machines.turning import AnaloguePath
from dtwin.parquet import table_of, write_parquet
from dtwin.schema import Run, RunMeta

# Of probe, encoder and accelerometer.
SAMPLE_HZ = 1000.0
BANDWIDTH_HZ = 50.0
Progress = Callable[[int, int, str], None]


def write_tone_campaign(
    folder: Path, runs: Iterable[Run], told: Mapping[str, Any], truth: str, name: str, machine: str,
    shown: tuple[Progress | None, int] = (None, 0), *, corrected: bool = False,
) -> None:  # fmt: skip
    """Write tones as a campaign folder; the campaign file comes last.

    Parameters
    ----------
    folder : Path
        Folder to write.
    runs : iterable of Run
        The tones; each is written when it comes.
    told : mapping
        What no instrument knows.
    truth : str
        Which mechanism it was.
    name, machine : str
        Of the campaign.
    shown : tuple
        What to call with (done, total, what), and the total.
    corrected : bool
        Whether a correction was in force.
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
    lines = [f"{k} = {toml_value(v)}" for k, v in told.items()]
    write_text(folder / "truth.toml", "\n".join([*lines, ""]), "the truth")
    text = _campaign_text(measured, truth, name, machine, corrected=corrected)
    write_text(folder / "campaign.toml", text, "the campaign file")


def _campaign_text(
    measured: Sequence[RunMeta], truth: str, name: str, machine: str, *, corrected: bool
) -> str:
    head: dict[str, Any] = {
        "type": "turning", "virtual": True, "corrected": corrected, "truth": truth, "z_bandwidth_hz": BANDWIDTH_HZ,
        "correction_delay_s": AnaloguePath().delay_s,
    }  # fmt: skip
    lines = [
        "[campaign]",
        f"name = {toml_value(name)}",
        f"machine = {toml_value(machine)}",
        'kind = "sinusoidal"',
        "[campaign.machine_geometry]",
        *(f"{k} = {toml_value(v)}" for k, v in head.items()),
        "[campaign.instrument]",
        'model = "virtual capacitance probe"',
        f"sample_rate_hz = {SAMPLE_HZ:g}",
    ]
    for meta in measured:
        lines += [
            "",
            "[[run]]",
            f'id = "{meta.run_id}"',
            f'file = "{meta.run_id}.parquet"',
            f'signals = "{meta.run_id}.accelerometers.parquet"',
            f"repeat = {meta.repeat}",
            "[run.condition]",
            'axis = "Z"',
            f"frequency_hz = {meta.condition['frequency_hz']:g}",
            f"amplitude_um = {meta.condition['amplitude_um']:g}",
        ]
        if meta.covariates:
            lines.append("[run.covariates]")
            lines += [f"{name} = {toml_value(value)}" for name, value in meta.covariates.items()]
    return "\n".join([*lines, ""])
