"""Logs of displacements beside temperatures, under the headers that they come with.

``[campaign.instrument.columns]`` names the house's column for a foreign header: ``"frame_t" = "temperature_frame_c"``. Other headers
say what they are by their units, in the header or in a row below: a length is a displacement, °C a temperature. Each displacement is
a run. A displacement in steps needs ``step_mm``, of the run's ``condition``, of the instrument, or in a comment of the file.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dtwin.acquire.foreign_columns import (
    CLOCK,
    PROBES,
    Column,
    below_heads,
    columns_of,
    header_row,
    in_english,
    joined_heads,
    require_one_table,
)
from dtwin.acquire.one_channel import require_one_channel
from dtwin.acquire.repeated_heads import require_one_block
from dtwin.acquire.spreadsheet import SUFFIXES as SPREADSHEETS
from dtwin.acquire.spreadsheet import first_rows, table_bytes
from dtwin.acquire.table_dialect import decoded, remarks_of, rows_of
from dtwin.acquire.time_stamps import FORM, newest_first, numbers_of, of_stamps
from dtwin.acquire.title_words import require_usual_sign
from dtwin.acquire.xmlsafe import number_or_none
from dtwin.errors import InputError
from dtwin.kinds.drift._clock import at_readings, require_rising, seconds_of, when
from dtwin.kinds.drift._series import sense
from dtwin.kinds.drift._standing import COLDEST_C, HOTTEST_C, lost_readings, nothing_read, possible, standing, stepped
from dtwin.positioning.table_heads import ANGLE
from dtwin.schema import Campaign, Finding, Floats, Run, RunMeta
from dtwin.units import ANGLES_DEG, is_number

_MOST_BYTES = 256 * 1024**2
_SUFFIXES = (".csv", ".txt", ".tsv", *SPREADSHEETS)
_MOVED = re.compile(
    rf"(displacement|deviation|verlagerung|drift|{PROBES}|(delta_?|[d\u03b4])?[xyz]\d?)(_?\d+)?(_\w+)?_um", re.I
)
_AXIS = re.compile(r"(?:^|_)(?:delta|[d\u03b4])?([xyz])\d?(?=_)", re.I)
_TRIGGERED = re.compile(r"trigger|(?<![a-z])pos(?![a-z])|position|antast|\bprobed\b|touch", re.I)
"""Head of what may be places at which a probe triggers."""
_RAW = re.compile(r"(?<![a-z])(raw|roh\w*|offset|zero)(?![a-z])", re.I)
_TRAVEL_UM = 10_000.0
_SPEED, _DRIFT_S = re.compile(r"speed|\brpm\b|drehzahl", re.I), 0.5
_OF_OTHERS = re.compile(r"(angle|position|error|speed(?!_rpm)|joint|direction|cmd|act)\w*_", re.I)
_NO_PROBE = re.compile(
    r"target|nominal|command|(?<![a-z])(?:cmd|mean|avg|average|mittel\w*)|(?<!un)(?:corrected|compensated|korrigiert|kompensiert)|soll|toler|limit|radius|diamet|durchm|run_?out|rundlauf|rough|rauh|rau_|stroke|length|wear"
    r"|uncertaint|unsicherheit|set_?point|predict|simulat|filter|gefiltert|geglättet|smooth|(?<![a-z])std|standard_dev|(?<!with_)(?<!without_)(?<!mit_)(?<!ohne_)(?:correction|korrektur|compensation|kompensation)",
    re.I,
)
_NO_SENSOR = re.compile(r"set_?point|target|nominal|command|soll|limit|grenz|alarm|uncertaint|unsicherheit", re.I)
_STEPS = "displacement_step"
_SAMPLE = "sample_1"
_STAMPED = "t_stamp"
"""A time without a unit: of stamps, for numbers might be of minutes."""
_WARM = re.compile(r"temp|°|grad", re.I)
_SLOPES = ("um/m", "µm/m", "mm/m")
_SLOPE = re.compile(r"[uµm]m_?(/|per_)m\b", re.I)
_TEMPERATURE = re.compile(r"temperature_\w+_c$")
_OTHER_DEGREES = re.compile(r"\s*(k|kelvin)\s*", re.I)
_SAME = 1e-6
_STEP_SAID = re.compile(r"^#.*\bstep_(?:dist|mm)\s*=\s*([0-9.eE+-]+)", re.M)


def _read_drift(path: Path, campaign: Campaign, stated: Mapping[str, Any]) -> tuple[list[Run], list[dict[str, Any]]]:
    """Return each displacement of a log as a run, and the rows that hold no usable number.

    Raises ``InputError`` when there is no displacement or no time, beside columns that are not known no temperature,
    or the size of a step is not told.
    """
    text = decoded(table_bytes(path, _MOST_BYTES))
    require_one_block(text, path)
    rows = rows_of(text)
    recipe = campaign.instrument.get("columns", {})
    said, units, body = _parted(rows, path)
    said_heads = said
    require_one_table(said, body, path)
    _require_degrees(said, units, recipe, path)
    heads, factors, zeros = _named(said, units, recipe)
    require_usual_sign([*remarks_of(text), *rows[: len(rows) - len(body)]], path)
    known = [
        i for i, name in enumerate(heads) if name in ("t_s", _STAMPED, _SAMPLE) or name.endswith(("_c", "_um", "_mm"))
    ]
    require_one_channel(said, body, known, path)
    column = {name: [row[i] for row in body] for i, name in enumerate(heads)}
    scales, zero_of = (dict(zip(heads, told, strict=True)) for told in (factors, zeros))
    temperatures = [name for name in heads if _TEMPERATURE.fullmatch(name)]
    moved = _displacements(heads)
    clock = next((name for name in ("t_s", _STAMPED) if name in column), "")
    # Without a temperature it is a log of displacements alone, if every column is known.
    unread = {*heads} - {"t_s", _STAMPED, _SAMPLE, *moved}
    if not moved or not clock or not body or (unread and not temperatures):
        foreign = [column.head for column in _unknown(said, units, recipe)]
        raise InputError(
            "a log of drift lacks columns",
            code="columns.missing",
            where=str(path),
            got=", ".join(said)[:200] or "nothing",
            allowed=f"a time, a displacement in µm, mm or as {_STEPS}, and a temperature in °C: t_s, displacement_um, temperature_NAME_c",
            hint=f"units that are not known here: {', '.join(foreign)[:120]}; write temperatures in °C"
            if foreign and not temperatures
            else 'other headers: [campaign.instrument.columns] with lines such as "frame_t" = "temperature_frame_c"',
        )
    cells = column[clock]
    once = (*moved, *temperatures)
    if twice := [head for head, name in zip(said, heads, strict=True) if name in once and heads.count(name) > 1]:
        raise InputError(
            "several columns are one displacement or temperature",
            code="drift.twice",
            where=str(path),
            got=", ".join(twice)[:80],
            allowed="one column of each; a position of the machine is no displacement",
            hint="leave one out, or rename it",
        )
    if clock == _STAMPED:
        # Day and time may stand apart.
        stamped = [i for i, name in enumerate(heads) if name == clock]
        cells = [" ".join(row[i].strip() for i in stamped) for row in body]
    named = " ".join(head for head, name in zip(said, heads, strict=True) if name == clock)
    t_s = seconds_of(cells, scales[clock], path, named, stamps=clock == _STAMPED)
    if newest_first(t_s):
        t_s, column = t_s[::-1], {name: values[::-1] for name, values in column.items()}
    require_rising(t_s[np.isfinite(t_s)], path)
    shared: dict[str, Floats] = {"t_s": t_s}
    shared |= {name: scales[name] * (numbers_of(column[name]) - zero_of[name]) for name in temperatures}
    if _SAMPLE in column:
        shared[_SAMPLE] = numbers_of(column[_SAMPLE])
    displaced = np.any([np.isfinite(numbers_of(column[name])) for name in moved], axis=0)
    between, said_of_them = at_readings(t_s, {name: shared[name] for name in temperatures}, displaced)
    shared |= between
    of_sensors = ~displaced & bool(said_of_them)
    cold = [
        Finding("drift.left_out", "warning", f"{column.head} is left out: {column.why_not}")
        for column in _unknown(said, units, recipe)
    ]
    cold += said_of_them
    if tilts := _tilts(said, units):
        told = f"{', '.join(tilts)[:120]}: tilts are left out, figures and twins are of displacements"
        cold.append(Finding("drift.tilts", "warning", told, {"columns_1": float(len(tilts))}))
    for name in temperatures:
        read = shared[name]
        if not possible(read).any():
            at = f"below {COLDEST_C:g}" if np.nanmax(read, initial=-np.inf) < COLDEST_C else f"above {HOTTEST_C:g}"
            said = f"{name} reads {at} °C throughout: no sensor is connected, and it is left out"
            cold.append(Finding("drift.no_sensor", "warning", said))
            del shared[name]
            continue
        if (gone := ~np.isfinite(read) & np.isfinite(t_s)).any():
            said = f"{name} has no reading in {gone.sum()} of {np.isfinite(t_s).sum()} rows, {when(t_s, gone)}: they are left out"
            cold.append(Finding("drift.missing", "warning", said, {"readings_1": float(gone.sum())}))
        if (lost := lost_readings(read)).any():
            said = f"{lost.sum()} readings of {name} leave their neighbours and come back, or are of no machine ({read[lost][0]:g} °C), {when(t_s, lost)}: the sensor dropped out, and the rows are left out"
            cold.append(Finding("drift.dropout", "warning", said, {"readings_1": float(lost.sum())}))
            shared[name] = read = np.where(lost, np.nan, read)
        if (stepped_at := stepped(t_s, read)).size:
            said = f"{name} steps between two readings, to {read[stepped_at[0]]:g} °C after {(t_s[stepped_at[0]] - np.nanmin(t_s)) / 60.0:z.0f} min: another unit (°F) or another sensor from there on, or one that came off; what follows from it is suspect"
            cold.append(Finding("drift.sensor_steps", "warning", said, {"steps_1": float(stepped_at.size)}))
    if not temperatures:
        said = "no temperature was logged: how far it drifted is told, and not what it follows"
        cold.append(Finding("drift.no_temperature", "warning", said))
    cold += standing(t_s, {name: shared[name] for name in temperatures if name in shared})
    runs, rejects = [], []
    sense(stated.get("condition", {}), str(path))
    told_by = dict(zip(heads, said_heads, strict=True))
    for name in moved:
        scale, findings = scales[name], list(cold)
        if _TRIGGERED.search(told_by[name]) and "reads" not in stated.get("condition", {}):
            said = f"{told_by[name].strip()} may be positions of the machine at which a probe triggers, whose sign is the opposite of the tool's displacement: state condition.reads as position or displacement"
            findings.append(Finding("drift.reads", "warning", said))
        if name == _STEPS:
            step, contradiction = _step_mm(path, text, campaign, stated)
            scale = 1e3 * step
            findings = [*contradiction, *cold]
        moved_um = numbers_of(column[name]) * scale
        if (lost := nothing_read(moved_um)).any():
            said = f"{lost.sum()} readings of {name} are 0 far off their neighbours, {when(t_s, lost)}: the probe read nothing, and the rows are left out"
            findings.append(Finding("drift.dropout", "warning", said, {"readings_1": float(lost.sum())}))
        samples = shared | {"displacement_um": np.where(lost, np.nan, moved_um)}
        if (gone := ~np.isfinite(moved_um) & np.isfinite(t_s) & ~of_sensors).any():
            said = f"the displacement has no reading in {gone.sum()} of {np.isfinite(t_s).sum()} rows, {when(t_s, gone)}: they are left out"
            findings.append(Finding("drift.missing", "warning", said, {"readings_1": float(gone.sum())}))
        good = np.all([np.isfinite(values) for values in samples.values()], axis=0)
        if not good.any():
            raise InputError("no row holds finite numbers", code="table.no_rows", where=f"{path} {name}")
        rejects += [{"row": int(r), "reason": "not finite", "values": {"column": name}} for r in np.flatnonzero(~good)]
        kept = {column_name: values[good] for column_name, values in samples.items()}
        kept["t_s"] = kept["t_s"] - kept["t_s"][0]
        kept["displacement_um"] = kept["displacement_um"] - kept["displacement_um"][0]
        # The axis that moved may stand in the header, where there are several.
        matched = _AXIS.search(name)
        letter = matched[1] if matched else None
        several = len(moved) > 1
        condition: dict[str, Any] = {"axis": letter.upper()} if several and letter else {}
        if name == _STEPS and "step_mm" not in campaign.instrument:
            condition["step_mm"] = scale / 1e3
        run_id = name.removesuffix("_um") if several else "log"
        meta = RunMeta(run_id=run_id, kind="drift", condition=condition, sample_rate_hz=float("nan"))
        runs.append(Run(meta, kept, source=str(path), findings=tuple(findings)))
    return runs, rejects


def is_drift_log(path: Path) -> bool:
    """Return whether the heads of a table are a time, displacements and temperatures; it is read no further than its beginning."""
    if path.suffix.lower() not in _SUFFIXES or not path.is_file():
        return False
    said, units, body = _parted(first_rows(path, _MOST_BYTES), path)
    heads, factors, _ = _named(said, units, {})
    told = _displacements(heads)
    # A log of something else may hold temperatures, too.
    others = (
        any(_OF_OTHERS.match(name) or name.endswith("_deg") for name in heads)
        or _turns(said, body, heads, factors)
        or any(_travels([row[i] for row in body], factors[i]) for i, name in enumerate(heads) if name in told)
    )
    # A log whose temperatures are all in another unit is refused as what it is.
    kelvin = any(_OTHER_DEGREES.fullmatch(column.unit) for column in _unknown(said, units, {}))
    warm = kelvin or any(map(_TEMPERATURE.fullmatch, heads))
    return bool({"t_s", _STAMPED} & set(heads)) and bool(told) and warm and not others


def _turns(said: Sequence[str], body: Sequence[Sequence[str]], heads: Sequence[str], factors: Sequence[float]) -> bool:
    """Return whether readings beside a speed follow faster than a log of drift is read: those are of a turning axis."""
    if "t_s" not in heads or not any(map(_SPEED.search, said)):
        return False
    clock = list(heads).index("t_s")
    steps = np.diff(numbers_of([row[clock] for row in body]) * factors[clock])
    return bool(np.isfinite(steps).any() and np.nanmedian(steps) < _DRIFT_S)


def _travels(cells: Sequence[str], factor: float) -> bool:
    """Return whether a column moves farther than heat moves a machine: it is a position."""
    moved = numbers_of(cells) * factor
    return bool(np.isfinite(moved).any() and np.nanmax(moved) - np.nanmin(moved) > _TRAVEL_UM)


def _displacements(heads: Sequence[str]) -> list[str]:
    """Return which columns are displacements: by their names, else the only length, whatever its name, which no other test has."""
    lengths = [name for name in heads if name == _STEPS or (name.endswith("_um") and not _NO_PROBE.search(name))]
    moved = [name for name in lengths if name == _STEPS or _MOVED.fullmatch(name)]
    # Beside another length a position is where the machine stands, not what its probe reads.
    moved = [name for name in moved if len(lengths) == 1 or "position" not in name.lower()]
    # What was read before it was evaluated, or a zero, is no run beside what was evaluated.
    moved = [name for name in moved if not _RAW.search(name)] or moved
    return moved or (lengths if sum(name.endswith("_um") for name in heads) == 1 else [])


def _parted(
    rows: Sequence[Sequence[str]], path: Path
) -> tuple[Sequence[str], Sequence[str] | None, list[Sequence[str]]]:
    """Return heads, which may stand below titles, units below them, and rows of as many cells."""
    rows = joined_heads(rows, path)
    try:
        begin = header_row(rows, path)
    except InputError:
        begin = 0
    heads = rows[begin] if rows else []
    units, below = below_heads(rows, begin)
    padding = [""] * len(heads)
    body: list[Sequence[str]] = [[*row, *padding][: len(heads)] for row in below]
    if units is not None:
        units = [*units, *padding][: len(heads)]
        forms = [cell.strip().strip("[]()").lower().replace("t", "d").replace("j", "y") for cell in units]
        clocks = [CLOCK.fullmatch(form.replace(" ", "")) is not None for form in forms]
        heads = [f"{head} [{form}]" if clock else head for head, form, clock in zip(heads, forms, clocks, strict=True)]
        units = ["" if clock else unit for unit, clock in zip(units, clocks, strict=True)]
    # Words below the log are no readings.
    while body and not any(map(str.isdigit, "".join(body[-1]))):
        del body[-1]
    return heads, units, body


def _named(
    row: Sequence[str], units: Sequence[str] | None, recipe: Mapping[str, Any]
) -> tuple[list[str], list[float], list[float]]:
    """Return the house's names of columns, and what makes a value v of the file f (v - zero) in their units.

    The units are µm of displacements, s and °C; f stands second, the zeros third.
    """
    plain = [cell.strip() for cell in row]
    names, factors, zeros = [], [], []
    for head, column in zip(plain, columns_of(plain, units, {}), strict=True):
        name, factor, zero = str(recipe.get(head, in_english(head))), 1.0, 0.0
        if head not in recipe and column.name:
            name = column.name
        # A name that the campaign gives does not say another unit of temperature than the head does.
        if column.zero or name == column.name:
            factor, zero = column.factor, column.zero
        if name.endswith("_c") and not _TEMPERATURE.fullmatch(name) and not _NO_SENSOR.search(name):
            name = f"temperature_{name}"
        elif of_stamps(name):
            name = _STAMPED
        elif name.lower() in ("sample", _SAMPLE):
            name = _SAMPLE
        elif name.endswith("_mm"):
            name, factor = f"{name.removesuffix('_mm')}_um", factor * 1e3
        names.append(name)
        factors.append(factor)
        zeros.append(zero)
    return names, factors, zeros


def _unknown(row: Sequence[str], units: Sequence[str] | None, recipe: Mapping[str, Any]) -> list[Column]:
    """Return columns that tell a unit, and are not used."""
    plain = [cell.strip() for cell in row]
    told, tilts = columns_of(plain, units, {}), _tilts(row, units)
    return [c for c in told if c.unit and c.why_not and c.head not in (*recipe, *tilts) and not FORM.search(c.head)]


def _tilts(row: Sequence[str], units: Sequence[str] | None) -> list[str]:
    """Return the heads of angles, of lengths over a length, too."""
    columns = columns_of([cell.strip() for cell in row], units, {})
    # Grad and ° are of temperatures, too.
    cold = [c for c in columns if not _WARM.search(f"{c.head} {c.unit}")]
    return [c.head for c in cold if ANGLE.search(c.head) or _SLOPE.search(c.head) or c.unit in (*ANGLES_DEG, *_SLOPES)]


def _require_degrees(row: Sequence[str], units: Sequence[str] | None, recipe: Mapping[str, Any], path: Path) -> None:
    """Refuse a head that says another unit of temperature than the name that ``campaign.toml`` gives it."""
    for column in columns_of([cell.strip() for cell in row], units, {}):
        told = str(recipe.get(column.head, ""))
        if _TEMPERATURE.fullmatch(told) and _OTHER_DEGREES.fullmatch(column.unit):
            raise InputError(
                "a temperature is in another unit than its name says",
                code="drift.unit",
                where=str(path),
                got=f"{column.head} named {told}"[:80],
                allowed="°C",
                hint="write it in °C; from K T - 273.15",
            )


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
    own = number_or_none(said[1]) if said else None
    if own is None or abs(own - step) <= _SAME * step:
        return step, ()
    told = f"campaign.toml states a step of {step:g} mm, the file {own:g}; that of campaign.toml is used"
    return step, (Finding("drift.step", "warning", told, {"told_step_mm": step, "read_step_mm": own}),)


READERS = dict.fromkeys(_SUFFIXES, _read_drift)
