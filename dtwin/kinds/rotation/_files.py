"""Files of a turning axis as channels: tables of one clock, and logs with one line a reading."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from dtwin.acquire.channel_log import LINE, is_channel_log
from dtwin.acquire.foreign_columns import is_number, joined_heads, require_one_of, require_one_table
from dtwin.acquire.repeated_heads import require_one_block
from dtwin.acquire.spreadsheet import SUFFIXES as SPREADSHEETS
from dtwin.acquire.spreadsheet import first_text, table_bytes
from dtwin.acquire.table_dialect import decoded, rows_of
from dtwin.acquire.time_stamps import FORMS, seconds_of
from dtwin.acquire.xmlsafe import number_or_none
from dtwin.errors import InputError
from dtwin.kinds.rotation._at_rest import is_at_rest
from dtwin.kinds.rotation._blocks import REPEAT, SPEED_ABOVE, below_speeds, cell_of, repeats_below
from dtwin.kinds.rotation._heads import (
    ANGLE,
    DISTANCES,
    PATH,
    PLACES,
    PROBE,
    PULSE,
    RUNOUT,
    SPEED,
    TIME,
    Column,
    assumed_of,
    column_of,
    is_dial,
    is_turning,
    require_whole,
)
from dtwin.local_time import was_set
from dtwin.schema import Finding, Floats

SUFFIXES = (".csv", ".txt", ".tsv", ".dat", ".log", *SPREADSHEETS)
_MOST_BYTES = 256 * 1024**2
_MOST_TITLES, _MOST_PROBES, _MOST_ON_ITS_SIDE = 20, 64, 200
_UNIX_S = 1e9
_MISSING = frozenset(("", "nan", "n/a", "na", "-", "--", "null", "none"))


@dataclass(frozen=True)
class Channel:
    """Readings of one quantity on its clock, both of shape (n,)."""

    t_s: Floats
    value: Floats


@dataclass
class Reading:
    """What a file holds.

    ``channels``: ``angle_deg``, ``pulse_1``, ``speed_rpm`` where they are there.
    ``probes``: displacements or, ``by_speed``, run-outs in µm, by the probe's name.
    ``apart``: whether each channel has stamps of its own.
    ``timed``: whether there is a time; else rows are counted.
    ``started``: ISO 8601 time of the first reading, empty when the file does not tell. ``assumed``: of its units.
    """

    channels: dict[str, Channel] = field(default_factory=dict)
    probes: dict[str, Channel] = field(default_factory=dict)
    by_speed: bool = False
    apart: bool = False
    timed: bool = True
    started: str = ""
    assumed: tuple[Finding, ...] = ()
    rejects: list[dict[str, Any]] = field(default_factory=list)


def is_rotation_file(path: Path) -> bool:
    """Return whether a file alone is surely of a turning axis; it is read no further than its beginning."""
    if path.suffix.lower() not in SUFFIXES or not path.is_file():
        return False
    text = first_text(path, _MOST_BYTES)
    return is_channel_log(text) or _headed(_upright(rows_of(text), path), {}) is not None


def read_file(path: Path, recipe: Mapping[str, Any], needed: str = PROBE) -> Reading:
    """Return the channels of a file.

    ``recipe``: the house's name for a foreign head or channel, ``[campaign.instrument.columns]``.
    ``needed``: ``angle_deg`` where the file is to give the angle of another one.

    Raises ``InputError`` when there is no probe, a unit is not told, or no row holds numbers.
    """
    text = decoded(table_bytes(path, _MOST_BYTES))
    if is_channel_log(text):
        return _from_log(text, recipe, path, needed)
    require_one_block(text, path, SPEED_ABOVE.search)
    return _from_table(_upright(rows_of(text), path), recipe, path, needed)


def _upright(rows: Sequence[Sequence[str]], path: Path) -> list[Sequence[str]]:
    """Return a table with its heads in a row, joined where they stand in two; one over speed may lie on its side, or in blocks."""
    rows = below_speeds(rows)
    wide = [row for row in rows if sum(bool(cell.strip()) for cell in row) > 1]
    if wide and 2 < len(wide[0]) <= _MOST_ON_ITS_SIDE:
        told = [SPEED_ABOVE.fullmatch(cell.strip()) for cell in wide[0][1:]]
        speeds = all(told) and len({cell[2] for cell in told if cell}) == 1
        if speeds and (corner := column_of(wide[0][0])).role == RUNOUT and corner.factor:
            # The first cell tells what stands below the speeds, and each row is another reading of it.
            names = (f"run {n}" if number_or_none(row[0]) else row[0] for n, row in enumerate(wide[1:], start=1))
            wide[1:] = [[f"{name} {wide[0][0]}", *row[1:]] for name, row in zip(names, wide[1:], strict=True)]
        elif _headed(rows, {}) is not None:
            return joined_heads(rows, path)
        if speeds:
            wide[0] = [f"speed {next(cell[2] for cell in told if cell)}", *(cell[1] for cell in told if cell)]
        numbers = all(number_or_none(cell) is not None for cell in wide[0][1:] if column_of(cell).role != SPEED)
        standing = list(zip_longest(*wide, fillvalue=""))
        if column_of(wide[0][0]).role == SPEED and numbers and _headed(standing, {}) is not None:
            return list(standing)
    return joined_heads(rows, path)


def _going_on(clock: Floats, speed: Floats) -> Floats:
    """Return a clock that goes on where it begins anew at another speed."""
    steps = np.diff(clock)
    anew = (steps < 0.0) & (np.abs(np.diff(speed)) > 0.0)
    usual = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 1.0
    return np.asarray(clock + np.concatenate([[0.0], np.cumsum(np.where(anew, usual - steps, 0.0))]))


def _headed(rows: Sequence[Sequence[str]], recipe: Mapping[str, Any]) -> tuple[int, list[Column], int] | None:
    """Return the row of heads, what they mean, and where values begin; None when no row is surely one."""
    for begin, row in enumerate(rows[:_MOST_TITLES]):
        table = None
        below = rows[begin + 1] if begin + 1 < len(rows) else []
        for units in ([], below):
            if units is below and (len(below) != len(row) or any(number_or_none(c) is not None for c in below)):
                continue
            cells = [*units, *[""] * (len(row) - len(units))]
            columns = [_meant(head, recipe, unit) for head, unit in zip(row, cells, strict=False)]
            at_rest = is_dial(columns) and _at_places(columns, rows[begin + 1 :])
            if is_turning(columns) or at_rest or (recipe and any(c.role == PROBE and c.factor for c in columns)):
                table = table or (begin, columns, begin + (2 if units else 1))
                if all(c.factor for c in columns if c.role not in ("", PATH)):
                    return begin, columns, begin + (2 if units else 1)
        if table is not None:
            return table
    return None


def _at_places(columns: Sequence[Column], body: Sequence[Sequence[str]]) -> bool:
    n = next(n for n, c in enumerate(columns) if c.role == ANGLE)
    return is_at_rest(_values(body, n, columns[n].factor))


def _meant(head: str, recipe: Mapping[str, Any], unit: str = "") -> Column:
    told = recipe.get(head.strip())
    if told is None:
        return column_of(head, unit)
    name = str(told)
    # Empty: the column is not to be used.
    return column_of(name) if name else Column("")


def _from_table(rows: Sequence[Sequence[str]], recipe: Mapping[str, Any], path: Path, needed: str) -> Reading:
    headed = _headed(rows, recipe)
    if headed is None:
        meant = [[_meant(head, recipe) for head in row] for row in rows[:_MOST_TITLES]] or [[]]
        # Below titles stands the first row with a probe and an angle.
        at = (n for n, row in enumerate(meant) if {PROBE, ANGLE} <= {c.role for c in row if c.factor})
        headed = (n := next(at, 0)), meant[n], n + 1
    begin, columns, first = headed
    heads = [cell.strip() for cell in rows[begin]] if rows else []
    _require(columns, heads, path, needed)
    require_one_table(heads, rows[first:], path)
    require_one_of(PLACES, heads, rows[first:], path)
    roles = {c.role for c in columns}
    if {SPEED, RUNOUT} <= roles:
        require_one_of(DISTANCES, heads, rows[first:], path, repeated=True)
        _require_alike(heads, columns, rows[first:], path)
    # Run-out beside an angle is read at each place of the turn.
    by_speed = not roles & {TIME, ANGLE} or (RUNOUT in roles and not roles & {ANGLE, PULSE})
    probes = [n for n, c in enumerate(columns) if c.role == PROBE or (c.role == RUNOUT and (by_speed or c.is_tir))]
    if by_speed and any(columns[n].role == RUNOUT for n in probes):
        probes = [n for n in probes if columns[n].role == RUNOUT]
    single = {role: n for n, c in reversed(list(enumerate(columns))) if (role := c.role) in (TIME, ANGLE, PULSE, SPEED)}
    body = list(rows[first:])
    by_hand = is_dial(columns) and _at_places(columns, body)
    if (by_speed and TIME not in single) or by_hand:
        columns, probes, body = repeats_below(heads, columns, probes, body)
    told = {n: _values(body, n, columns[n].factor) for n in (*single.values(), *probes) if n != single.get(TIME)}
    clock, started = np.arange(len(body), dtype=np.float64), ""
    if TIME in single:
        clock, started = _clock([cell_of(row, single[TIME]) for row in body], columns[single[TIME]].factor, path)
    bare = {heads[n]: columns[n] for role, n in single.items() if not (role == TIME and started)}
    assumed = assumed_of([cell for row in rows[begin:first] for cell in row], bare)
    reading = Reading(by_speed=by_speed, timed=TIME in single, started=started, assumed=assumed)
    shared = np.isfinite(clock)
    for role, n in single.items():
        if role != TIME:
            shared &= np.isfinite(told[n])
    if not by_speed and shared.any():
        clock[shared] = _going_on(clock[shared], told[single[SPEED]][shared]) if SPEED in single else clock[shared]
        clock[shared] = _rising(clock[shared], path)
    names = _names([columns[n].name for n in probes])
    for role, n in single.items():
        if role != TIME:
            reading.channels[role] = Channel(clock[shared], told[n][shared])
    for name, n in zip(names, probes, strict=True):
        good = shared & np.isfinite(told[n])
        if good.any():
            reading.probes[name] = Channel(clock[good], told[n][good])
        bad = [r for r in np.flatnonzero(~good) if cell_of(body[r], n).lower() not in _MISSING]
        reading.rejects += [
            {"row": int(r), "reason": "not a number", "values": {heads[n]: cell_of(body[r], n)[:40]}} for r in bad
        ]
    if needed == PROBE:
        _require_rows(reading, len(body), path)
    return reading


def _from_log(text: str, recipe: Mapping[str, Any], path: Path, needed: str) -> Reading:
    """Return the channels of a log with one line a reading; names mean what ``recipe`` says."""
    stamps: dict[str, list[float]] = {}
    values: dict[str, list[float]] = {}
    seen: Counter[str] = Counter()
    reading = Reading(apart=True)
    origin: datetime | None = None
    for row, line in enumerate(text.splitlines()):
        cells = LINE.match(line)
        if cells is None:
            if line.strip() and not line.startswith("#"):
                reading.rejects.append({"row": row, "reason": "no reading", "values": {"line": line[:80]}})
            continue
        name, day, time, value = cells.groups()
        seen[name] += 1
        if name not in recipe:
            continue
        number = number_or_none(value)
        try:
            at = datetime.fromisoformat(f"{day} {time.replace(',', '.')}")
        except ValueError:
            number = None
        if number is None:
            reading.rejects.append({"row": row, "reason": "not a number", "values": {name: value[:40]}})
            continue
        origin = origin or at
        stamps.setdefault(name, []).append((at - origin).total_seconds())
        values.setdefault(name, []).append(number)
    columns = {name: _meant(name, recipe) for name in stamps}
    if not any(c.role == needed for c in columns.values()):
        raise InputError(
            "a log with one line a reading does not say which of its channels is what",
            code="rotation.channels",
            where=str(path),
            got=", ".join(f"{name} ({n})" for name, n in seen.most_common(12))[:400],
            allowed="of a turning axis angle_deg, speed_rpm, and NAME_mm or NAME_um for each probe, such as radial_top_mm",
            hint='a campaign.toml with [campaign.instrument.columns] and lines such as "CHANNEL" = "angle_deg"; '
            "docs/how-to/rotation.md; a log of another test: dtwin import",
        )
    _require(list(columns.values()), list(columns), path, needed)
    probes = [name for name, c in columns.items() if c.role == PROBE]
    for name, label in zip(probes, _names([columns[n].name for n in probes]), strict=True):
        reading.probes[label] = _ordered(stamps[name], values[name], columns[name].factor)
    for name, column in columns.items():
        if column.role in (ANGLE, PULSE, SPEED):
            reading.channels[column.role] = _ordered(stamps[name], values[name], column.factor)
    reading.started = origin.isoformat() if origin and was_set(origin) else ""
    return reading


def _ordered(t_s: Sequence[float], values: Sequence[float], factor: float) -> Channel:
    """Return readings in the order of their stamps; of several with one stamp the last."""
    t = np.array(t_s)
    order = np.argsort(t, kind="stable")
    t, v = t[order], np.array(values)[order] * factor
    last = np.append(np.diff(t) > 0.0, True)
    return Channel(t[last], v[last])


def _require(columns: Sequence[Column], heads: Sequence[str], path: Path, needed: str) -> None:
    """Refuse a file without a probe, or with a column whose unit is not told."""
    probes = [n for n, c in enumerate(columns) if c.role in (PROBE, RUNOUT)]
    there = bool(probes) if needed == PROBE else any(c.role == needed for c in columns)
    if not there or len(probes) > _MOST_PROBES:
        raise InputError(
            "a file of a turning axis lacks columns",
            code="columns.missing",
            where=str(path),
            got=", ".join(heads)[:200] or "nothing",
            allowed="time, angle or a pulse a turn or speed, and displacements in mm or µm; or speed and run-out",
            hint='other heads: [campaign.instrument.columns] with lines such as "CH3" = "radial_x_um"',
        )
    require_whole(heads, columns, path)
    without = [heads[n] for n, c in enumerate(columns) if c.role not in ("", PATH) and not c.factor]
    if without:
        raise InputError(
            "a column does not say its unit, or one that its quantity cannot have",
            code="rotation.unit",
            where=str(path),
            got=", ".join(without)[:120],
            allowed="[mm], [µm], [nm] or [in] behind a displacement (volts need the scale of the probe); s, ms; deg, rad, rev; rpm, 1/min, Hz, rad/s",
            hint='the unit behind the name in the head, such as "run-out [µm]"',
        )
    roles = [c.role for c in columns if c.role in (TIME, ANGLE, SPEED)]
    if twice := sorted(role for role in set(roles) if roles.count(role) > 1):
        raise InputError(
            "two columns are the same quantity",
            code="rotation.twice",
            where=str(path),
            got=", ".join(twice),
            hint='[campaign.instrument.columns] with "HEAD" = "" leaves one out',
        )


def _require_alike(heads: Sequence[str], columns: Sequence[Column], body: Sequence[Sequence[str]], path: Path) -> None:
    """Refuse run-outs that a column of words parts, each with every speed: of several states or parts they are no repeats."""
    speed = next(n for n, c in enumerate(columns) if c.role == SPEED)
    for n in (n for n, c in enumerate(columns) if not c.role and not REPEAT.fullmatch(heads[n])):
        read: dict[str, set[str]] = {}
        for row in body:
            if cell_of(row, n) and cell_of(row, speed):
                read.setdefault(cell_of(row, n), set()).add(cell_of(row, speed))
        words = not all(map(is_number, read)) and not any(":" in name for name in read)
        if words and len(read) > 1 and all(one == set().union(*read.values()) for one in read.values()):
            raise InputError(
                "a column parts the rows, and is not read: run-outs of several states or parts are no repeats",
                code="table.several",
                where=f"{path} {heads[n]}",
                got=", ".join(read)[:80],
                allowed="one; repeats under a head such as run",
                hint="a file for each",
            )


def _rising(t_s: Floats, path: Path) -> Floats:
    """Return times of which readings with one stamp are spread evenly; raises ``InputError`` when they fall."""
    falls = np.flatnonzero(np.diff(t_s) < 0.0)
    if falls.size or (t_s.size > 1 and t_s[0] == t_s[-1]):
        at = int(falls[0]) if falls.size else 0
        raise InputError(
            "the time does not rise",
            code="rotation.clock",
            where=f"{path} reading {at + 2}",
            got=f"{t_s[at]:g}, then {t_s[at + 1]:g}",
            hint="a file for each run",
        )
    first = np.flatnonzero(np.diff(t_s, prepend=-np.inf) > 0.0)
    if len(first) in (len(t_s), 0):
        return t_s
    ends = np.append(first, len(t_s))
    stamps = np.append(t_s[first], 2.0 * t_s[first[-1]] - t_s[first[-2]])
    return np.interp(np.arange(len(t_s)), ends, stamps)


def _require_rows(reading: Reading, rows: int, path: Path) -> None:
    if reading.probes:
        return
    words = reading.rejects[0]["values"] if reading.rejects else {}
    raise InputError(
        "no row holds finite numbers", code="table.no_rows", where=str(path), got=str(words or f"{rows} rows")[:120]
    )


def _names(names: Sequence[str]) -> list[str]:
    """Return names of which none occurs twice."""
    count: Counter[str] = Counter()
    out = []
    for name in names:
        count[name] += 1
        out.append(name if count[name] == 1 else f"{name}-{count[name]}")
    return out


def _values(body: Sequence[Sequence[str]], n: int, factor: float) -> Floats:
    cells = (number_or_none(cell_of(row, n)) for row in body)
    return np.array([np.nan if v is None else v * factor for v in cells], dtype=np.float64)


def _clock(cells: Sequence[str], factor: float, path: Path) -> tuple[Floats, str]:
    """Return times in seconds, NaN where there is none, and when they began, where stamps tell."""
    numbers = np.array([np.nan if (v := number_or_none(c)) is None else v * factor for c in cells], dtype=np.float64)
    # Of numbers of this size the unit is told by it.
    if np.isfinite(numbers).any() and not (factor == 1.0 and np.nanmin(numbers) > _UNIX_S):
        return numbers, ""
    times, started = seconds_of(cells, str(path))
    if not np.isfinite(times).any():
        raise InputError(
            "times are of no known form",
            code="rotation.time",
            where=str(path),
            got=(cells[0] if cells else "nothing")[:40],
            allowed=f"seconds, milliseconds; or {FORMS}",
        )
    return times, started
