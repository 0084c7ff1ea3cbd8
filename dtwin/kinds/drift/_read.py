"""Logs of a displacement beside temperatures, under the headers that they come with.

``[campaign.instrument.columns]`` names the house's column for a foreign header: ``"frame_t" = "temperature_frame_c"``. A
displacement in steps needs ``step_mm``, of the run's ``condition``, of the instrument, or in a comment of the file.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from dtwin.acquire.spreadsheet import table_bytes
from dtwin.errors import InputError
from dtwin.schema import Campaign, Finding, Floats, Run, RunMeta
from dtwin.units import is_number

_MOST_BYTES = 256 * 1024**2
_UM_PER: Mapping[str, float] = {"displacement_um": 1.0, "displacement_mm": 1e3}
_STEPS = "displacement_step"
_TEMPERATURE = re.compile(r"temperature_\w+_c$")
_SAME = 1e-6
_STEP_SAID = re.compile(r"^#.*\bstep_(?:dist|mm)\s*=\s*([0-9.eE+-]+)", re.M)
_STAMPS = ("%Y/%m/%d-%H:%M:%S", "%Y-%m-%d %H:%M:%S", "%d.%m.%Y %H:%M:%S")
_COLDEST_C = -60.0


def read_drift(path: Path, campaign: Campaign, stated: Mapping[str, Any]) -> tuple[list[Run], list[dict[str, Any]]]:
    """Return one log as a run, and the rows that hold no usable number.

    Raises ``InputError`` when there is no displacement, no temperature or no time, or the size of a step is not told.
    """
    text = table_bytes(path, _MOST_BYTES).decode("utf-8-sig", errors="replace")
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    semicolon = bool(lines) and lines[0].count(";") > lines[0].count(",")
    rows = list(csv.reader(lines, delimiter=";" if semicolon else ","))
    recipe = campaign.instrument.get("columns", {})
    heads = [str(recipe.get(head.strip(), head.strip())) for head in (rows[0] if rows else [])]
    body = [row for row in rows[1:] if len(row) == len(heads)]
    column = {name: [row[i] for row in body] for i, name in enumerate(heads)}
    temperatures = [name for name in heads if _TEMPERATURE.fullmatch(name)]
    moved = next((name for name in (*_UM_PER, _STEPS) if name in column), None)
    if moved is None or not temperatures or "t_s" not in column or not body:
        raise InputError(
            "a log of drift lacks columns",
            code="columns.missing",
            where=str(path),
            got=", ".join(rows[0])[:200] if rows else "nothing",
            allowed=f"t_s, {', '.join(_UM_PER)} or {_STEPS}, and temperature_NAME_c",
            hint='other headers: [campaign.instrument.columns] with lines such as "frame_t" = "temperature_frame_c"',
        )
    findings: list[Finding] = []
    scale = _UM_PER.get(moved, 0.0)
    if moved not in _UM_PER:
        step, contradiction = _step_mm(path, text, campaign, stated)
        scale = 1e3 * step
        findings += contradiction
    samples = {"t_s": _seconds(column["t_s"], path), "displacement_um": _numbers(column[moved], semicolon) * scale}
    samples |= {name: _numbers(column[name], semicolon) for name in temperatures}
    if "sample" in column:
        samples["sample_1"] = _numbers(column["sample"], semicolon)
    for name in temperatures:
        if np.nanmax(samples[name]) < _COLDEST_C:
            said = f"{name} reads below {_COLDEST_C:g} °C throughout: no sensor is connected, and it is left out"
            findings.append(Finding("drift.no_sensor", "warning", said))
            del samples[name]
    good = np.all([np.isfinite(values) for values in samples.values()], axis=0)
    if not good.any():
        raise InputError("no row holds finite numbers", code="table.no_rows", where=str(path))
    rejects = [{"row": int(r), "reason": "not finite", "values": {}} for r in np.flatnonzero(~good)]
    kept = {name: values[good] for name, values in samples.items()}
    kept["t_s"] = kept["t_s"] - kept["t_s"][0]
    kept["displacement_um"] = kept["displacement_um"] - kept["displacement_um"][0]
    meta = RunMeta(run_id="log", kind="drift", sample_rate_hz=float("nan"))
    return [Run(meta, kept, source=str(path), findings=tuple(findings))], rejects


def _step_mm(path: Path, text: str, campaign: Campaign, stated: Mapping[str, Any]) -> tuple[float, tuple[Finding, ...]]:
    """Return the size of a step, and that the file itself says another one."""
    said = _STEP_SAID.search(text)
    told = stated.get("condition", {}).get("step_mm", campaign.instrument.get("step_mm", said[1] if said else None))
    try:
        step = float(told)
    except (TypeError, ValueError):
        step = float("nan")
    if not is_number(step) or not 0.0 < step < 1e3:
        raise InputError(
            "the size of a step is not told",
            code="drift.step",
            where=str(path),
            got=str(told)[:40],
            allowed="step_mm in [campaign.instrument] or in the run's condition, above 0",
        )
    own = _number_or_none(said[1]) if said else None
    if own is None or abs(own - step) <= _SAME * step:
        return step, ()
    told = f"campaign.toml states a step of {step:g} mm, the file {own:g}; that of campaign.toml is used"
    return step, (Finding("drift.step", "warning", told, {"told_step_mm": step, "read_step_mm": own}),)


def _number_or_none(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def _numbers(cells: Sequence[str], comma: bool) -> Floats:
    out = np.full(len(cells), np.nan)
    for i, cell in enumerate(cells):
        try:
            out[i] = float(cell.replace(",", ".") if comma else cell)
        except ValueError:
            continue
    return out


def _seconds(cells: Sequence[str], path: Path) -> Floats:
    """Return times in seconds: numbers, ISO 8601, or a stamp of a known form."""
    numbers = _numbers(cells, True)
    if np.isfinite(numbers).all():
        return numbers
    for form in (None, *_STAMPS):
        try:
            made = [datetime.fromisoformat(c) if form is None else datetime.strptime(c, form) for c in cells]
        except ValueError:
            continue
        return np.array([(stamp - made[0]).total_seconds() for stamp in made])
    raise InputError(
        "times are of no known form",
        code="drift.time",
        where=str(path),
        got=cells[0][:40],
        allowed="seconds, or ISO 8601",
    )
