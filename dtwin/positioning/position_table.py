"""Tables of a positioning test as people keep them: targets, cycles, two directions.

Four forms are known by what stands in them:

* one row a target: a column of targets, and one for each cycle and direction (``forward 1``, ``bwd_1``, ``+1``, ``hin 1``);
* one row a target and cycle: columns of targets, cycles, and one for each direction (``forward``, ``reverse``);
* one row a reading: target, direction, cycle, and a position or a deviation; or one row a target and direction, with a column for
  each cycle, which may lie on its side, as the table of ISO 230-2 does;
* assignments: ``TGT_DATA[1]=15``, ``REF_DATA_FWD[1,1]=15.01``, ``REF_DATA_BWD[1,1]=...``, ``UNIT=mm``.

In a report in Markdown the tables of these forms are read; direction or target may stand in the heading above.
A column is in the unit that its head or a row of units states (mm, um, µm, in; of an axis that turns deg, arcsec, ″). It holds deviations when its head says so
(deviation, error, Abweichung) or is in micrometres, else positions, from which the target is taken away. Targets and positions without
a unit are millimetres, or degrees, which is said; deviations must state theirs.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from dtwin.acquire.axis_titles import AXIS_CHOSEN, axes_named, axis_by_row, part_of_axis, parts_by_axis, require_axis
from dtwin.acquire.repeated_heads import require_one_block
from dtwin.acquire.spreadsheet import SUFFIXES as SPREADSHEETS
from dtwin.acquire.spreadsheet import first_text, has_other_axes, table_bytes
from dtwin.acquire.table_dialect import SUMMARY, decoded, remarks_of, rows_of
from dtwin.acquire.time_stamps import clock_of, newest_first
from dtwin.acquire.xmlsafe import number_or_none
from dtwin.positioning._angles import angles_as_targets, names_angles, of_angles, tells_angles, with_degrees
from dtwin.positioning._one_place import joined_targets, one_place, probings_of, trials_of, with_joined_targets
from dtwin.positioning._one_state import require_one_state
from dtwin.positioning._plain_table import rows_of_axis, table_of, told_apart
from dtwin.positioning._refusals import (
    LITTLE,
    factor_of,
    of_other_unit,
    require_counted,
    require_cycles,
    require_deviations,
    require_near,
    require_not_exchanged,
    require_one_axis,
    require_positioning,
    require_stops,
    require_unit_of,
    require_unit_of_heads,
)
from dtwin.positioning._report_tables import (
    instruments_beside,
    of_one_instrument,
    report_tables,
    stated_figures,
    without_remarks,
)
from dtwin.positioning.assignments import Reading, assigned_readings, assigned_unit, is_assigned, number_in, wrong_form
from dtwin.positioning.matrix import names_sense, no_direction, ways_in_order
from dtwin.positioning.position_runs import PositionTable, runs_of, said_of
from dtwin.positioning.table_heads import (
    AXIS,
    MISSING,
    MOST_TITLES,
    TURNS,
    Long,
    Wide,
    axes_beside,
    deviation_of,
    is_length,
    is_row_of_units,
    long_of,
    names_no_direction,
    names_target,
    other_targets,
    told_unit,
    wide_of,
)
from dtwin.positioning.ways import LENGTHS, Scale, way_of
from dtwin.schema import Campaign, Finding, Floats, Run
from dtwin.units import ANGLES_DEG

SUFFIXES = (".csv", ".dat", ".txt", ".tsv", ".md", *SPREADSHEETS)
_CONSOLE = ".log"
_MAX_BYTES = 16 * 1024 * 1024


def is_position_table(path: Path) -> bool:
    """Return whether a file looks like one of the forms; it is read no further than its beginning."""
    return axis_turns(path) is not None


def axis_turns(path: Path) -> bool | None:
    """Return whether a file that looks like one of the forms is of an axis that turns; None of any other file."""
    if path.suffix.lower() not in (*SUFFIXES, _CONSOLE) or not path.is_file():
        return None
    return _turns(first_text(path, _MAX_BYTES), path.suffix.lower() == _CONSOLE)


# Several kinds ask of the same file.
@lru_cache(4)
def _turns(text: str, console: bool) -> bool | None:
    """Return what ``axis_turns`` does of a text; ``console``: what was written along with a probing."""
    if console:
        return False if probings_of(text) else None
    if is_assigned(text):
        return assigned_unit(text) in ANGLES_DEG
    text = angles_as_targets(next(iter(parts_by_axis(text).values()), text))
    rows = with_degrees(rows_of(text))
    words = [cell for row in rows[:MOST_TITLES] for cell in row if number_or_none(cell) is None]
    if axis_by_row(rows) is not None and not any(map(way_of, words)):
        # Places in space: no axis moved alone.
        return None
    tables: list[Sequence[Sequence[str]]] = [
        with_degrees(table.rows) for table in report_tables(text, rows) or instruments_beside(rows)
    ]
    plain = None if tables else table_of(rows)
    if tables or plain is not None:
        return all(of_angles(table[:2]) for table in tables or [plain or ()])
    if names_no_direction(rows):
        return tells_angles(rows[:MOST_TITLES])
    return False if trials_of(rows, LENGTHS) or probings_of(text) else None


def read_position_runs(
    path: Path, campaign: Campaign, stated: Mapping[str, Any], scale: Scale = LENGTHS
) -> tuple[list[Run], list[dict[str, Any]]]:
    """Read a table as runs, each one cycle: forward through ascending targets, then back.

    ``stated``: the ``[[run]]`` entry; repeats count on from the one that it states.
    """
    condition = stated.get("condition", {})
    axis = str(condition.get("axis", ""))
    whole = decoded(table_bytes(path, _MAX_BYTES, axis))
    part = part_of_axis(whole, axis, path)
    require_one_block(part, path, way_of, names_target)
    text = angles_as_targets(part)
    every = with_degrees(rows_of(text))
    rows, told = rows_of_axis(every, axis)
    require_axis(told or axes_named([*remarks_of(part), *rows[:MOST_TITLES]], axis), axis, path)
    others = part != whole or len(rows) < len(every) or has_other_axes(path, axis)
    first = [cell for row in rows[:MOST_TITLES] for cell in row]
    turns = f"axis {axis}, and no unit of length" if TURNS.fullmatch(axis) else next(filter(names_angles, first), "")
    lengths = any(map(is_length, first)) or assigned_unit(text) in LENGTHS.units
    if not scale.turn and turns and not lengths:
        raise of_other_unit(scale, path, turns.strip()[:60])
    table = _table_in(text, rows, path, str(condition.get("instrument", "")), scale)
    said = [*stated_figures(text, table.forward_um, table.reverse_um), *said_of(table)]
    if others:
        said.append(
            Finding(AXIS_CHOSEN, "info", f"the file holds other axes, too: what is called {axis} in it was read")
        )
    return runs_of(table, path, stated, said), []


def _table_in(
    text: str, rows: Sequence[Sequence[str]], path: Path, instrument: str = "", scale: Scale = LENGTHS
) -> PositionTable:
    """Return the table of a text of any of the forms, whose cells are ``rows``; ``instrument``: of a report of several.

    Raises ``InputError`` when a cell is no number, or targets, cycles or directions do not belong together.
    """
    if is_assigned(text):
        of_one_instrument([], instrument, path)
        told = matrix_of(assigned_readings(text, path, scale), path, scale)
        return replace(told, unit_told=bool(assigned_unit(text)))
    if trials := trials_of(rows, scale) or (not scale.turn and probings_of(text)):
        raise one_place(path, trials, scale.fine)
    report = of_one_instrument(report_tables(text, rows) or instruments_beside(rows), instrument, path)
    tables: list[Sequence[Sequence[str]]] = [with_degrees(table.rows) for table in report]
    if not tables:
        require_positioning([*remarks_of(text), *rows], path)
        plain = table_of(rows)
        require_one_axis(axes_beside([*rows[:MOST_TITLES], [row[0] for row in rows]]), str(path))
        if plain is None and (head := names_no_direction(rows)):
            raise no_direction(
                path,
                head,
                f"heads such as forward 1 [{scale.unit}], reverse 1 [{scale.unit}]; of a test in one direction forward 1 [{scale.unit}], forward 2 [{scale.unit}]",
            )
        if plain is None:
            raise wrong_form("the table is of no known form", path, ", ".join(rows[0])[:120] if rows else "nothing")
        tables = [plain]
    read: list[list[Reading]] = []
    in_order = False
    for lines in tables:
        require_unit_of(scale, lines[:2], path)
        require_unit_of_heads(scale, [*remarks_of(text), *rows], lines, path)
        wide, long = wide_of(lines[0]), long_of(lines[0])
        read.append(
            _from_wide(lines, wide, path, scale) if wide else _from_long(lines, long, path, scale) if long else []
        )
        in_order = in_order or (wide is None and long is not None and long.way is None)
    # A single pass of its own beside repeated cycles is another test.
    several = [any(reading[2] > 1 for reading in readings) for readings in read]
    kept = [readings for readings, more in zip(read, several, strict=True) if more or not any(several)]
    single = zip(report, read, several, strict=bool(report))
    left_out = dict.fromkeys(t.title for t, readings, more in single if readings and not more and any(several))
    every = [reading for readings in kept for reading in readings]
    name = report[0].read_with if report else ""
    table = replace(matrix_of(_as_they_are(every, scale), path, scale), read_with=name)
    require_near(table, path)
    apart = next(filter(None, map(told_apart, tables)), "")
    table = replace(table, otherwise=table.by_position and not any(reading[4] for reading in every))
    stated = all(map(_tells_units, tables))
    return replace(table, in_order=in_order, unit_told=stated, left_out=tuple(left_out), apart=apart)


def _as_they_are(readings: Sequence[Reading], scale: Scale) -> list[Reading]:
    """Return readings of an axis that turns within half a turn, and those whose head says one thing and whose values are the other: positions in µm, deviations in mm."""
    target_um = np.array([reading[0] for reading in readings]) * scale.per
    told_um = np.array([reading[3] for reading in readings])
    size = float(np.abs(target_um - target_um.mean()).max()) if len(readings) else 0.0
    within, positions = _within_turn(told_um, scale), np.array([reading[4] for reading in readings], dtype=bool)
    # Told as deviations: they grow as the targets do. Told as positions: what is left is the target itself.
    for alike, sign in ((~positions, 1.0), (positions, -1.0)):
        off = _within_turn(told_um - sign * target_um, scale)[alike]
        if off.size and size > 0.0 and float(np.ptp(off)) < LITTLE * size:
            within[alike], positions[alike] = off, sign > 0.0
    return [(*r[:3], float(um), bool(told)) for r, um, told in zip(readings, within, positions, strict=True)]


def _within_turn(off: Floats, scale: Scale) -> Floats:
    """Return deviations of an axis that turns within half a turn: 359.9998 at a target of 0 is short of it."""
    turn = scale.turn * scale.per
    return off - turn * np.round(off / turn) if turn else off


def matrix_of(readings: Sequence[Reading], path: Path, scale: Scale = LENGTHS) -> PositionTable:
    """Return readings as a table.

    Cycles of one direction each, as 1 forward, 2 reverse, 3 forward, are sweeps: they are counted by direction.

    Raises ``InputError`` when there are fewer than two targets, or one is read twice in a cycle and direction.
    """
    sweeps = {way: sorted({r[2] for r in readings if r[1] == way}) for way in ("forward", "reverse")}
    numbers = sorted(number for matrices in sweeps.values() for number in matrices)
    if all(sweeps.values()) and numbers == list(range(1, len(numbers) + 1)):
        readings = [(r[0], r[1], sweeps[r[1]].index(r[2]) + 1, r[3], r[4]) for r in readings]
    readings, joined_mm = with_joined_targets(readings)
    targets = sorted({reading[0] for reading in readings})
    cycles = max((reading[2] for reading in readings), default=0)
    if len(targets) == 1 < cycles:
        raise one_place(
            path, {way: [r[3] for r in readings if r[1] == way] for way in ("forward", "reverse")}, scale.fine
        )
    if len(targets) < 2 or not 1 <= cycles <= 1000:
        raise wrong_form("a positioning test needs two targets and a cycle", path, f"{len(targets)} targets")
    place = {target: i for i, target in enumerate(targets)}
    matrices = {way: np.full((len(targets), cycles), np.nan) for way in ("forward", "reverse")}
    for target, way, cycle, deviation, _ in readings:
        cell = place[target], cycle - 1
        if np.isfinite(matrices[way][cell]):
            got = f"{way}, cycle {cycle}, {target:g} {scale.unit}"
            said = "a reading stands there twice: say which cycle each belongs to, and of which axis it is"
            raise wrong_form(said + "; the end of a turn is 360, not 0" * bool(scale.turn), path, got)
        matrices[way][cell] = deviation
    by_position = all(reading[4] for reading in readings)
    return PositionTable(
        np.array(targets), matrices["forward"], matrices["reverse"], by_position, joined_mm=joined_mm, scale=scale
    )


def _from_wide(rows: Sequence[Sequence[str]], wide: Wide, path: Path, scale: Scale) -> list[Reading]:
    heads, units, body = _parted(rows, wide.target, path)
    wide = replace(wide, cycle=_not_counting(wide.cycle, wide.target, body))
    require_counted(heads, wide, path)
    read = {wide.target, *(i for i, _, _ in wide.cells)}
    factor = {
        i: factor_of(heads[i], units[i] if units is not None and i < len(units) else "", path, scale) for i in read
    }
    again = other_targets(heads, wide.target)
    out = []
    seen: Counter[float] = Counter()
    summed = [i for i in (wide.cycle, wide.target) if i is not None]
    numbered = [
        (f"{path}, row {number} below the heads", row)
        for number, row in enumerate(body, start=1)
        if not any(SUMMARY.fullmatch(row[i].strip()) for i in summed if i < len(row))
    ]
    targets = [number_in(row, wide.target, where) * factor[wide.target] for where, row in numbered]
    one = joined_targets(targets)
    require_one_state(heads, [row for _, row in numbered], [one[t] for t in targets], read | {wide.cycle}, path)
    for (where, row), target in zip(numbered, targets, strict=True):
        if any(i < len(row) and row[i].strip() and row[i].strip() != row[wide.target].strip() for i in again):
            raise wrong_form("two columns of targets do not agree: a row is one target", Path(where), str(row)[:80])
        seen[one[target]] += 1
        counted = seen[one[target]] if wide.cycle is None else _cycle(row, wide.cycle, where)
        for i, way, cycle in wide.cells:
            if i < len(row) and row[i].strip().lower() not in MISSING:
                value = number_in(row, i, where) * factor[i]
                out.append((target, way, cycle or counted, *deviation_of(heads[i], factor[i], value, target, scale)))
    return out


def _from_long(rows: Sequence[Sequence[str]], long: Long, path: Path, scale: Scale) -> list[Reading]:
    heads, units, body = _parted(rows, long.target, path)
    clock = clock_of(heads, units, body, str(path))
    if long.way is None:
        require_stops(clock, path)
    if newest_first(clock):
        body = body[::-1]
    long = replace(long, cycle=_not_counting(long.cycle, long.target, body))
    below = [units[i] if units is not None and i < len(units) else "" for i in (long.target, long.value)]
    factors = (
        factor_of(heads[long.target], below[0], path, scale),
        factor_of(heads[long.value], below[1], path, scale),
    )
    numbered = [(f"{path}, row {number} below the heads", row) for number, row in enumerate(body, start=1)]
    targets = [number_in(row, long.target, where) * factors[0] for where, row in numbered]
    said, read = ([row[i].strip() for row in body if i < len(row)] for i in (long.target, long.value))
    require_not_exchanged(said, read, (heads[long.target], heads[long.value]), path)
    require_deviations(heads, units or (), body, long, path, scale)
    one = joined_targets(targets)
    if long.way is None and len(set(one.values())) == 1 < len(targets):
        value_um = [number_or_none(row[long.value]) for _, row in numbered if long.value < len(row)]
        raise one_place(path, {"": [um * factors[1] * scale.per for um in value_um if um is not None]}, scale.fine)
    ordered = ways_in_order([one[target] for target in targets]) if long.way is None else None
    if long.way is None and ordered is None:
        raise no_direction(
            path, ", ".join(heads), "a column direction; or targets in the order in which they were approached"
        )
    out: list[Reading] = []
    seen: Counter[tuple[float, str]] = Counter()
    ways = ordered or ["".join(row[long.way or 0 :][:1]).strip() for row in body]
    require_one_state(heads, body, list(zip(map(one.get, targets), ways, strict=True)), vars(long).values(), path)
    for (where, row), target, in_order in zip(numbered, targets, ordered or [""] * len(targets), strict=True):
        told = row[long.value].strip().lower() if long.value < len(row) else ""
        lost = told in MISSING
        value = float("nan") if lost else number_in(row, long.value, where) * factors[1]
        way = in_order or (way_of(row[long.way], ones=True) if long.way is not None and long.way < len(row) else None)
        if way is None and long.way is not None and names_sense("".join(row[long.way :][:1])):
            raise no_direction(Path(where), row[long.way], "+ or -, forward or reverse")
        if way is None:
            raise wrong_form("a reading without a direction", Path(where), str(row)[:80])
        seen[one[target], way] += 1
        cycle = seen[one[target], way] if long.cycle is None else _cycle(row, long.cycle, where)
        if not lost:
            out.append((target, way, cycle, *deviation_of(heads[long.value], factors[1], value, target, scale)))
    if long.cycle is not None:
        require_cycles((reading[2] for reading in out), heads[long.value], path)
    return out


def _not_counting(cycle: int | None, target: int, body: Sequence[Sequence[str]]) -> int | None:
    """Return the column of cycles; None where it counts the rows: of several targets no two are of one cycle."""
    rows = [row for row in body if cycle is not None and max(cycle, target) < len(row)]
    told = [row[cycle].strip() for row in rows] if cycle is not None else []
    several = len({row[target].strip() for row in rows}) > 1
    return None if several and len(set(told)) == len(told) else cycle


def _parted(
    rows: Sequence[Sequence[str]], target: int, path: Path
) -> tuple[Sequence[str], Sequence[str] | None, Sequence[Sequence[str]]]:
    """Return heads, the row of units below them, and the rows of one axis, without what else is written there."""
    heads, body = rows[0], list(rows[1:])
    units = body.pop(0) if body and is_row_of_units(body[0], target) else None
    body = without_remarks(heads, [row for row in body if row != units], target)
    for i in (i for i, head in enumerate(heads) if AXIS.match(head.strip())):
        axes = sorted({row[i].strip() for row in body if i < len(row)} - {""})
        require_one_axis(axes, f"{path} {heads[i].strip()}", in_column=True)
    return heads, units, body


def _tells_units(table: Sequence[Sequence[str]]) -> bool:
    """Return whether targets, and what was read at them, state their units: in heads, or below them."""
    heads, below = table[0], table[1] if len(table) > 1 else ()
    wide, long = wide_of(heads), long_of(heads)
    read = [wide.target, *(i for i, _, _ in wide.cells)] if wide else [long.target, long.value] if long else []
    units = below if is_row_of_units(below, read[0]) else ()
    return all(told_unit(heads[i], units[i] if i < len(units) else "") for i in read)


def _cycle(row: Sequence[str], i: int, where: str) -> int:
    cycle = number_in(row, i, where)
    if cycle < 1 or cycle % 1:
        raise wrong_form("cycles count from 1", Path(where), f"{cycle:g}")
    return int(cycle)
