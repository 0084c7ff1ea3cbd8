"""A table of readings from its heads on: below titles, on its side, with heads in two rows, with directions beside its targets."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from itertools import zip_longest

from dtwin.acquire.axis_titles import axis_of
from dtwin.acquire.foreign_columns import is_number
from dtwin.acquire.table_dialect import SUMMARY
from dtwin.positioning._report_tables import name_of
from dtwin.positioning.table_heads import (
    AXIS,
    MOST_TITLES,
    SUMS_UP,
    UNIT_INSIDE,
    by_way_of,
    is_row_of_units,
    is_unit,
    long_of,
    names_target,
    told_unit,
    wide_of,
)
from dtwin.positioning.ways import way_of

_MOST_ON_ITS_SIDE = 2000
_LETTER = re.compile(r"(?<![a-z])[xyz](?![a-z])")
_MARKED = re.compile(r"([+-]?\d+(?:\.\d+)?)\s*([^\d\s.,:/].*)")
"""A target with the direction behind it."""
_CONDITION = re.compile(
    r"(feed|speed|velocity|vorschub|load|payload|mass|last\b|height|h[oö]he|(motor|drive|id)$)", re.I
)
"""Head of a column of numbers that, where each has all targets, parts tests."""
_FEWEST_ALIKE = 4


def table_of(rows: Sequence[Sequence[str]]) -> list[Sequence[str]] | None:
    """Return a table from its heads on, which may stand in its first column; None when there is none."""
    rows = _halves_below(_ways_apart(rows))
    table = _below_titles(rows)
    # Titles have one cell.
    wide = [row for row in rows if sum(bool(cell.strip()) for cell in row) > 1]
    # What was logged has more rows than a table on its side has heads.
    if table is None and wide and max(len(wide), *map(len, wide)) <= _MOST_ON_ITS_SIDE:
        table = _below_titles(list(zip_longest(*wide, fillvalue="")))
        if table is not None and len(table[0]) > _FEWEST_ALIKE and len(set(table[0][1:])) == 1:
            # The reflector that a tracker measured again and again.
            return None
    return table


def _ways_apart(rows: Sequence[Sequence[str]]) -> list[Sequence[str]]:
    """Return rows whose targets tell their directions, ``100+`` and ``100 -``, ``100 ↑``, with a column of these behind that of targets."""
    begin = next((n for n, row in enumerate(rows[:MOST_TITLES]) if any(map(names_target, row))), None)
    if begin is None:
        return list(rows)
    target = next(i for i, head in enumerate(rows[begin]) if names_target(head))
    cells = [row[target] if target < len(row) else "" for row in rows]
    told = [_MARKED.fullmatch(cell.strip()) for cell in cells]
    ways = [way_of(mark[2]) if mark else None for mark in told]
    # Of one sign alone it may be that of the number.
    sure = len(set(filter(None, ways))) == 2 or any(
        mark and way and mark[2] not in "+-\u2212" for mark, way in zip(told, ways, strict=True)
    )
    if not any(ways) or not sure or any(map(is_number, cells)):
        return list(rows)
    return [
        [*row[:target], mark[1] if mark and way else cell, "direction" if n == begin else way or "", *row[target + 1 :]]
        for n, (row, cell, mark, way) in enumerate(zip(rows, cells, told, ways, strict=True))
    ]


def _halves_below(rows: Sequence[Sequence[str]]) -> list[Sequence[str]]:
    """Return a half for each direction beside each other, with targets of its own, as one table with a column of directions; other rows as they are.

    The direction stands in the heads of a half, or above them.
    """
    for begin, row in enumerate(rows[:MOST_TITLES]):
        places = [i for i, head in enumerate(row) if names_target(head)]
        if len(places) != 2:
            continue
        halves = slice(*places), slice(places[1], None)
        above = rows[begin - 1] if begin else ()
        ways = [{way_of(cell) for cell in (*above[half], *row[half])} - {None} for half in halves]
        # Between the halves a column may be empty.
        heads = [row[half][: max(i for i, head in enumerate(row[half], 1) if head.strip())] for half in halves]
        alike = [[(name_of(head), told_unit(head, ""), re.findall(r"\d+", head)) for head in half] for half in heads]
        if sorted(map(list, ways)) != [["forward"], ["reverse"]] or alike[0] != alike[1]:
            continue
        before, width = list(row[: places[0]]), len(heads[0])
        table = [[*before, "direction", heads[0][0], *(f"reading {head}" for head in heads[0][1:])]]
        body = rows[begin + 1 :]
        units = body[0] if body and is_row_of_units(body[0], places[0]) else None
        table += [[*units[: places[0]], "", *units[halves[0]]]] if units is not None else []
        for half, (way,) in zip(halves, ways, strict=True):
            lines = [[*line[: places[0]], str(way), *line[half][:width]] for line in body if line is not units]
            told = [line[len(before) + 1 :][:1] for line in lines]
            table += [
                line
                for line, at in zip(lines, told, strict=True)
                if "".join(at).strip() and not SUMMARY.fullmatch(at[0].strip())
            ]
        return [*rows[: max(begin - 1, 0)], *table]
    return list(rows)


def _one_reading_a_row(
    heads: Sequence[str], body: Sequence[Sequence[str]], by_way: tuple[int, int, tuple[tuple[int, int], ...]]
) -> list[Sequence[str]]:
    """Return a table of one row a target and direction as one of a row a reading; a target that is merged stands once."""
    target, way, cycles = by_way
    out: list[Sequence[str]] = [(heads[target], "direction", "cycle", f"reading {heads[cycles[0][0]]}")]
    if body and is_row_of_units(body[0], target):
        out.append((body[0][target], "", "", "".join(body[0][cycles[0][0] :][:1])))
    last = ""
    for row in (row for row in body if way < len(row) and row[way].strip() and _is_reading(row, way, cycles[0][0])):
        last = row[target].strip() or last
        out += [(last, row[way], str(cycle), row[i]) for i, cycle in cycles if i < len(row)]
    return out


def _is_reading(row: Sequence[str], way: int, first: int) -> bool:
    """Return whether a row is one of readings, also where its direction is not known; rows that sum up others are none."""
    told = row[way].strip()
    return way_of(told) is not None or (
        not SUMMARY.fullmatch(told) and not SUMS_UP.search(told) and first < len(row) and is_number(row[first])
    )


def _below_titles(rows: Sequence[Sequence[str]]) -> list[Sequence[str]] | None:
    """Return a table from its heads on, None when there is none; heads in two rows, as under merged cells, become one."""
    for begin, row in enumerate(rows[:MOST_TITLES]):
        below = list(rows[begin + 1 :])
        if below and {"x", "y", "z"} <= {re.split(r"[\s\[(_]", cell.strip().lower())[0] for cell in below[0]}:
            # Under merged heads these are coordinates of places.
            continue
        if {"x", "y", "z"} <= {
            letter for cell in filter(names_target, row) for letter in _LETTER.findall(cell.lower())
        }:
            # Commanded places, though a column tells how they were approached.
            continue
        by_way = by_way_of(row)
        if by_way is not None:
            return _one_reading_a_row(row, below, by_way)
        if wide_of(row) is not None or long_of(row) is not None:
            return [row, *below]
        numbers = any(is_number(a) and is_number(b) for a, b in zip(row, below[0] if below else (), strict=False))
        if below and sum(bool(cell.strip()) for cell in row) > 1 and not numbers:
            filled, last = [], ""
            for cell in row:
                last = cell.strip() or last
                filled.append(last)
            joined = [f"{a} {b}".strip() for a, b in zip_longest(filled, below[0], fillvalue="")]
            lying = any(cell.strip()[:1].isalpha() and not is_unit(cell) for line in below[1:2] for cell in line[:1])
            wide = wide_of(joined)
            # A number below the target's head is a target, and its row no second row of heads.
            target = below[0][wide.target : wide.target + 1] if wide is not None else []
            if wide is not None and not any(map(is_number, target)) and not way_of(filled[0]) and not lying:
                return [[_unit_last(head) for head in joined], *below[1:]]
    return None


def _unit_last(head: str) -> str:
    """Return a head of two rows with the unit at its end: ``forward [µm] 1`` becomes ``forward 1 [µm]``."""
    unit = UNIT_INSIDE.search(head)
    return head if unit is None else f"{head[: unit.start()]}{head[unit.end() :]} {unit[0].strip()}"


def rows_of_axis(rows: Sequence[Sequence[str]], axis: str) -> tuple[list[Sequence[str]], list[str]]:
    """Return a table without the rows that its column of axes says are of others, and what it says; any other table as it is."""
    for begin, row in enumerate(rows[:MOST_TITLES]):
        columns = [i for i, head in enumerate(row) if AXIS.match(head.strip())]
        if columns:
            body, asked = rows[begin + 1 :], axis.upper()
            told_in = {i: {line[i].strip().upper() for line in body if i < len(line)} - {""} for i in columns}
            # Several that are alike have names, or numbers, of any kind.
            called = [
                i for i in columns if len(told_in[i]) > 1 and asked in told_in[i] and not axis_of(axis, bare=True)
            ]
            letters = [i for i in columns if any(axis_of(cell, bare=True) for cell in told_in[i])]
            column = [*called, *letters, *columns][0]
            kept, mine = list(rows[: begin + 1]), True
            told: dict[str, None] = {}
            for line in body:
                # Of merged cells the first alone is filled.
                cell = line[column].strip() if column < len(line) else ""
                named = cell.upper() if called else axis_of(cell, bare=True)
                mine = named == asked if named else mine
                told |= {named: None} if named else {}
                kept += [line] if mine else []
            return (kept if asked in told else list(rows)), list(told)
    return list(rows), []


def told_apart(table: Sequence[Sequence[str]]) -> str:
    """Return head and words of a column that is not known here, and of which each word, or number of several cycles, has all targets, where cycles are counted; else nothing."""
    wide, long = wide_of(table[0]), long_of(table[0])
    columns = wide or long
    if columns is None or columns.cycle is not None:
        return ""
    cells = [i for i, _, _ in wide.cells] if wide else [long.way, long.value] if long else []
    read = {columns.target, *cells}
    way = long.way if long and not wide else None
    place = [columns.target] if way is None else [columns.target, way]
    once = 1 if wide or way is not None else 2
    for i, head in enumerate(table[0]):
        there: dict[str, Counter[tuple[str, ...]]] = {}
        for row in table[1:] if i not in read and not AXIS.match(head.strip()) else ():
            if max(i, *place) < len(row) and is_number(row[columns.target]) and row[i].strip():
                there.setdefault(row[i].strip(), Counter()).update([tuple(row[n].strip() for n in place)])
        words = _CONDITION.match(head.strip()) or all(name[0].isalpha() for name in there)
        # A number that counts cycles has no target twice, or there and back where nothing tells the direction.
        several = words or all(min(often.values()) > once for often in there.values())
        if several and len(there) > 1 and len({frozenset(often) for often in there.values()}) == 1:
            return f"{head.strip()} ({', '.join(there)})"
    return ""
