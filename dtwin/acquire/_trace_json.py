"""Ballbar Trace result files (JSON): long records without marked arcs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from dtwin.acquire._readings import require_usable
from dtwin.acquire.xmlsafe import read_bounded
from dtwin.errors import InputError
from dtwin.schema import Direction, Finding, Run, RunMeta
from dtwin.units import is_number

_FACTOR_TO_UM = {"millimetres": 1000.0, "millimeters": 1000.0, "micrometres": 1.0, "microns": 1.0}
_DIRECTIONS: dict[float, Direction] = {0: "CCW", 1: "CW"}


def read_trace_json(path: Path, *, sample_rate_hz: float | None = None) -> tuple[Run, ...]:
    """Read every run of a Ballbar Trace file.

    The file states neither rate, radius, feed nor angles; the campaign folder does.

    ``path``: the exported ``.json``.
    ``sample_rate_hz``: rate of the instrument. Without it times are sample numbers and a finding says so.
    """
    where = str(path)
    document = _parse(read_bounded(path), where)
    unit = str(document.get("ErrorUnits", "")).lower()
    if unit not in _FACTOR_TO_UM:
        raise InputError(
            "the file does not state a known unit",
            code="trace.unit",
            where=where,
            got=unit[:40] or "nothing",
            allowed=", ".join(_FACTOR_TO_UM),
        )
    stated = document.get("Runs")
    if not isinstance(stated, list) or not stated:
        raise InputError("the file holds no runs", code="trace.no_runs", where=where)
    return tuple(
        _read_run(entry, number, _FACTOR_TO_UM[unit], sample_rate_hz, where)
        for number, entry in enumerate(stated, start=1)
    )


def _parse(data: bytes, where: str) -> dict[str, Any]:
    try:
        document = json.loads(data.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise InputError(
            "not a readable JSON file",
            code="trace.malformed",
            where=where,
            got=str(error)[:160],
            hint="the export may be cut short: export it again",
        ) from error
    if not isinstance(document, dict):
        raise InputError("not a Ballbar Trace export", code="trace.malformed", where=where)
    return document


def _read_run(entry: Any, number: int, to_um: float, rate_hz: float | None, where: str) -> Run:
    place = f"{where} run {number}"
    readings = entry.get("Readings") if isinstance(entry, dict) else None
    if not isinstance(readings, list) or len(readings) < 3:
        raise InputError("the run holds no readings", code="trace.readings", where=place)
    if not all(map(is_number, readings)):
        raise InputError("a reading is not a finite number", code="trace.readings", where=place)
    values = np.array(readings, dtype=float)
    require_usable(values, place)
    stated = entry.get("Direction")
    direction = _DIRECTIONS.get(stated) if is_number(stated) else None
    if direction is None:
        raise InputError(
            "the run does not say its direction",
            code="trace.direction",
            where=place,
            got=repr(stated)[:40],
            allowed="0 (CCW) or 1 (CW)",
        )
    findings: tuple[Finding, ...] = ()
    if rate_hz is None:
        findings = (
            Finding(
                "clock.no_rate", "warning", "the file states no sample rate: times are sample numbers, feed is unknown"
            ),
        )
    rate = rate_hz or 1.0
    samples = {"t_s": np.arange(len(readings)) / rate, "deviation_um": values * to_um}
    meta = RunMeta(run_id=f"run-{number}", direction=direction, sample_rate_hz=rate)
    return Run(meta=meta, samples=samples, source=where, findings=findings)
