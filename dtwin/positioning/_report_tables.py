"""Readings of several instruments beside each other in one table, tables in a report in Markdown, and the figures of ISO 230-2 that such a report states."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dtwin.acquire.foreign_columns import is_number
from dtwin.acquire.table_dialect import rows_of
from dtwin.errors import InputError
from dtwin.physics.linear import linear_figures
from dtwin.positioning.matrix import other_formulas_um
from dtwin.positioning.table_heads import (
    MISSING,
    MOST_TITLES,
    OTHER_TEST,
    OWN_SENSOR,
    SUMS_UP,
    SURELY_READ,
    SURELY_TARGET,
    is_deviation,
    is_index,
    is_length,
    is_opposite,
    is_row_of_units,
    is_unit,
    long_of,
    names_target,
    told_unit,
    unit_of,
    wide_of,
)
from dtwin.positioning.ways import way_of
from dtwin.schema import Finding, Floats
from dtwin.units import LENGTHS_MM, UM_PER_MM, shown_number

_RULE = re.compile(r"^\s*\|?\s*:?-{2,}:?\s*(\|\s*:?-{2,}:?\s*)*\|?\s*$")
_HEADING = re.compile(r"^(#{1,6})\s+(.*)$")
_TARGET_TOLD = re.compile(r"\b(?:target|position|set ?point|soll\w*|ziel\w*)\D{0,12}?([-+]?\d+(?:[.,]\d+)?)", re.I)
_STATED = re.compile(r"^[\s*_|]*([BMERA])\s*[=:|]\s*([-+]?\d+(?:[.,]\d+)?)\s*\[?(mm|um|µm|μm)\b", re.M)
_FIGURES = {
    "B": "reversal_um",
    "M": "mean_deviation_um",
    "E": "systematic_um",
    "R": "repeatability_um",
    "A": "accuracy_um",
}
# Of a figure: what a report may lose by rounding its readings.
_ROUNDED = 0.005
_DIFFERENCE = re.compile(r"\bdiff", re.I)
_CYCLES = re.compile(r"cycle|zyklus|\b(run|lauf)\b", re.I)
_SERIES = re.compile(
    r"\W*(messreihe|serie|série|series|run|cycle|zyklus|lauf|test|messung|measurement|essai|prova|prueba)\W*(n[or]\W*)?\d+\W*",
    re.I,
)
"""Title of a block of a test, one a cycle."""


@dataclass(frozen=True)
class _ReportTable:
    """A table of readings: its head, in words that a plain table has, and its rows.

    ``read_with``, ``title``: the instrument, as its columns call it, and the heading above.
    """

    rows: Sequence[Sequence[str]]
    read_with: str
    title: str = ""


def report_tables(text: str, rows: Sequence[Sequence[str]]) -> list[_ReportTable]:
    """Return the tables of readings of a text in Markdown, or of one with a table for each direction; none when it is neither.

    ``rows``: those of the text.
    """
    return _of_markdown(text) or _of_each_way(rows)


def _of_each_way(rows: Sequence[Sequence[str]]) -> list[_ReportTable]:
    """Return the tables below titles of a single cell that name the directions; none where there are no two."""
    parts: list[tuple[str, list[list[str]]]] = [("", [])]
    for row in rows:
        filled = [cell.strip() for cell in row if cell.strip()]
        if len(filled) == 1 and not is_number(filled[0]):
            # A remark between such a title and its rows is none.
            if way_of(filled[0]) or parts[-1][1]:
                parts.append((filled[0], []))
        else:
            parts[-1][1].append([cell.strip() for cell in row])
    told = [(title, body) for title, body in parts if way_of(title) and len(body) > 1]
    both = {way_of(title) for title, _ in told} == {"forward", "reverse"}
    if len(told) < 2 or any(OTHER_TEST.search(t) for t, _ in parts):
        return []
    # Heads may stand once, above the first title; readings there are of no direction.
    above = parts[0][1]
    if any(all(is_number(cell) for cell in row if cell) for row in above):
        return []
    told = [(title, [*above[-1:], *body] if any(map(is_number, body[0])) else body) for title, body in told]
    tables = (t for title, body in told for t in _told_by_heading(body[0], body[1:], [title])) if both else ()
    return _of_each_sweep(told) or list(tables)


def _of_each_sweep(told: Sequence[tuple[str, Sequence[Sequence[str]]]]) -> list[_ReportTable]:
    """Return as one the tables of a row a reading below titles such as ``Messreihe 1 vorwärts``; none where they are of another form."""
    heads = told[0][1][0]
    long = long_of(heads)
    # Blocks before and after a change are no sweeps of one test.
    alike = len({name_of(title) for title, _ in told}) == 1 and all(body[0] == heads for _, body in told)
    if long is None or long.way is not None or long.cycle is not None or not alike:
        return []
    numbers = [re.search(r"\d+", title) for title, _ in told]
    seen: Counter[str | None] = Counter()
    rows: list[Sequence[str]] = []
    for (title, body), number in zip(told, numbers, strict=True):
        way = way_of(title)
        seen[way] += 1
        cycle = number[0] if number is not None and all(numbers) else str(seen[way])
        units = body[1:2] if len(body) > 1 and is_row_of_units(body[1], long.target) else []
        rows += [["", "", *unit] for unit in units if not rows]
        rows += [[str(way), cycle, *row] for row in without_remarks(heads, body[1 + len(units) :], long.target)]
    return [_ReportTable([["direction", "cycle", *heads], *rows], "")]


def _of_markdown(text: str) -> list[_ReportTable]:
    """Return the tables of a text in Markdown that hold readings; none when it is no such text."""
    lines = text.splitlines()
    tables = []
    above: list[str] = []
    for number, line in enumerate(lines):
        heading = _HEADING.match(line)
        if heading:
            above = [*above[: len(heading[1]) - 1], *[""] * (len(heading[1]) - 1 - len(above)), heading[2]]
        if number and "|" in line and _RULE.match(line) and "|" in lines[number - 1]:
            body = _cells(_until_no_table(lines[number + 1 :]))
            heads = [cell.strip() for cell in lines[number - 1].strip().strip("|").split("|")]
            title = next((heading for heading in above[::-1] if heading), "")
            tables += [replace(table, title=title) for table in _told_by_heading(heads, body, above[::-1])]
    return tables


def _until_no_table(lines: Sequence[str]) -> list[str]:
    end = next((i for i, line in enumerate(lines) if "|" not in line), len(lines))
    return list(lines[:end])


def _cells(lines: Sequence[str]) -> list[list[str]]:
    """Return the cells of rows, their decimal commas as points."""
    return rows_of("\n".join("\t".join(c.strip() for c in line.strip().strip("|").split("|")) for line in lines))


def _told_by_heading(heads: list[str], body: list[list[str]], above: Sequence[str]) -> list[_ReportTable]:
    """Return a table for each instrument, with the direction or the target that the nearest heading says; none without readings."""
    if not any(map(names_target, heads)):
        target = next((m[1] for heading in above if (m := _TARGET_TOLD.search(heading))), None)
        if target is None or not {"forward", "reverse"} <= {way_of(head) for head in heads}:
            return []
        heads, body = ["target mm", *heads], [[target.replace(",", "."), *row] for row in body]
    read = [i for i, head in enumerate(heads) if not names_target(head) and not is_index(head)]
    back = any(way_of(heads[i]) == "reverse" for i in read)
    values = [i for i in read if (way_of(heads[i]) if back else re.search(r"\d", heads[i]))]
    label = ", ".join(sorted({name_of(heads[i]) for i in values}))
    way = next((way for heading in above if (way := way_of(heading))), None)
    if way is not None and not back and (beside := _beside(heads, body, way)):
        return beside
    # Without columns of the way back, pos in a head is a position.
    if way is not None and not back and len(values) > 1 and long_of(heads) is None:
        heads = [_numbered(head, way) if i in values else head for i, head in enumerate(heads)]
    if wide_of(heads) is None and long_of(heads) is None:
        return []
    return [_ReportTable([heads, *body], label)]


def _beside(heads: Sequence[str], body: Sequence[Sequence[str]], way: str) -> list[_ReportTable]:
    """Return what instruments read beside each other, one row a target or a target and cycle, all on one way; else none."""
    target = min(
        (i for i, head in enumerate(heads) if names_target(head)), key=lambda i: not unit_of(heads[i]), default=None
    )
    cycle = next((i for i, head in enumerate(heads) if _CYCLES.search(head) and not unit_of(head)), None)
    read = [
        i
        for i, head in enumerate(heads)
        if i not in (target, cycle) and unit_of(head) and not is_index(head) and not _DIFFERENCE.search(head)
    ]
    names = [name_of(heads[i]) for i in read]
    if target is None or not names or len(set(names)) < len(names) or long_of(heads) is not None:
        return []
    rows = [row for row in body if max(read) < len(row) and is_number(row[target])]
    head = [f"target [{unit_of(heads[target])}]", "direction", *([] if cycle is None else ["cycle"])]
    return [
        _ReportTable(
            [
                [*head, f"actual [{unit_of(heads[i])}]"],
                *([row[target], way, *([] if cycle is None else [row[cycle]]), row[i]] for row in rows),
            ],
            name,
        )
        for i, name in zip(read, names, strict=True)
    ]


def _numbered(head: str, way: str) -> str:
    """Return ``forward 1 [mm]`` for a column of readings of one cycle, such as ``ref_pos(i,1) [mm]``."""
    number = re.findall(r"\d+", head)[-1]
    return f"{'deviation ' if is_deviation(head) else ''}{way} {number} [{unit_of(head)}]"


def name_of(head: str) -> str:
    """Return what a head says beside direction, cycle and unit: what was read, or with what."""
    words = re.findall(r"[^\W_]+", head.strip().rstrip("])").removesuffix(unit_of(head)))
    return " ".join(w for w in words if way_of(w) is None and not w.isdigit() and w.lower() not in ("i", "j"))


def of_one_instrument(tables: Sequence[_ReportTable], wanted: str, path: Path) -> list[_ReportTable]:
    """Return the tables of an instrument; refuse those of several without a choice: their readings would be taken for one test.

    ``wanted``: its name, in any case; empty where none is asked for.
    """
    names = sorted({table.read_with for table in tables}, key=str.lower)
    chosen = [name for name in names if not wanted or name.lower() == wanted.lower()]
    example = next((name for name in names if name and not OWN_SENSOR.search(name)), next(iter(names), ""))
    if len(chosen) != 1 and (tables or wanted):
        raise InputError(
            f"the file holds no readings that it calls {wanted[:40]}"
            if wanted
            else "the file holds readings of several instruments",
            code="position_table.instruments",
            where=str(path),
            got=", ".join(name or "one without a name" for name in names)[:120] or "a table that names no instrument",
            allowed="one of them, one campaign each" if names else "the table without a choice",
            hint=f'--instrument "{example}", or condition = {{ instrument = "{example}" }} in the [[run]]'
            if names
            else "leave the instrument away",
        )
    return [table for table in tables if table.read_with in chosen]


def stated_figures(text: str, forward_um: Floats, reverse_um: Floats) -> list[Finding]:
    """Return how B, M, E, R and A that a report states agree with those of its readings; nothing where it states none."""
    stated = {symbol: (number, unit) for symbol, number, unit in _STATED.findall(text)}
    if not stated or not (np.isfinite(forward_um).all() and np.isfinite(reverse_um).all()) or forward_um.shape[1] < 2:
        return []
    ours = linear_figures(forward_um, reverse_um)
    others = other_formulas_um(forward_um, reverse_um)
    same, formula, apart = [], [], []
    for symbol, (number, unit) in stated.items():
        scale = LENGTHS_MM[unit] * UM_PER_MM
        theirs, value = float(number.replace(",", ".")) * scale, float(getattr(ours, _FIGURES[symbol]))
        digits = len(re.split(r"[.,]", number)[1]) if re.search(r"[.,]", number) else 0
        near = 2.0 * scale * 10.0**-digits + _ROUNDED * abs(value)
        if abs(theirs - value) <= near:
            same.append(symbol)
        elif symbol in others and abs(theirs - others[symbol]) <= near:
            formula.append(
                f"{symbol} {shown_number(theirs, 4)} µm is of another formula than the standard's, which gives {shown_number(value, 4)} µm"
            )
        else:
            apart.append(
                f"{symbol} is stated as {shown_number(theirs, 4)} µm, and its readings give {shown_number(value, 4)} µm"
            )
    told = [f"{', '.join(same)} as here"] if same else []
    said = f"figures that the file states: {'; '.join([*told, *formula, *apart])}"
    return [Finding("linear.stated_figures", "warning" if apart else "info", said, {"apart_1": float(len(apart))})]


_INSTRUMENT = re.compile(
    rf"laser|interferom|\b(xl|xm)-?\d|tracker|taster|\bprobe|messuhr|dial|indicator|lvdt|grid|gauge|(glas|linear|ma(ß|ss)).?s(cale|tab)|{OWN_SENSOR.pattern}",
    re.I,
)
_READ = re.compile(
    r"act|actual|measured|measurement|reading|value|wert|messwert|ist|istwert|istposition|position|pos|of|by|(dev|err|abw|fehler)\w*",
    re.I,
)
"""Words of a head that say that something was read, not by what."""
_PLACES = re.compile(r"pos(ition)?\b(?![ ._]*(no|nr|num|number|nummer)\b)", re.I)


def instruments_beside(rows: Sequence[Sequence[str]]) -> list[_ReportTable]:
    """Return a table for each instrument that heads of a plain table name; none where they name none, or no more than is read anyway.

    Where a column without a name stands beside those of the axis's own sensors, it holds the readings.
    """
    for begin, row in enumerate(rows[:MOST_TITLES]):
        if any(OTHER_TEST.search(cell) for cell in row):
            return []
        tables = _of_heads([cell.strip() for cell in row], rows[begin + 1 :])
        if tables:
            return tables
    return []


def _of_heads(heads: Sequence[str], below: Sequence[Sequence[str]]) -> list[_ReportTable]:
    target = next((i for i, h in enumerate(heads) if names_target(h) and not _INSTRUMENT.search(h)), None)
    if target is None or not below:
        return []
    units = below[0] if is_row_of_units(below[0], target) else []
    unit = [told_unit(head, units[i] if i < len(units) else "") for i, head in enumerate(heads)]
    named: dict[str, list[int]] = {}
    others: dict[str, list[int]] = {}
    unknown: dict[str, list[int]] = {}
    for i in (i for i, head in enumerate(heads) if i != target and _may_be_read(head) and is_unit(unit[i])):
        words = name_of(heads[i])
        name = " ".join(word for word in words.split() if not _READ.fullmatch(word))
        if _INSTRUMENT.search(name):
            named.setdefault(name, []).append(i)
        elif SURELY_READ.match(heads[i]) or is_deviation(heads[i]) or way_of(heads[i]):
            others.setdefault(words or "readings", []).append(i)
        elif name and is_length("", unit[i]) == is_length("", unit[target] or unit[i]):
            unknown.setdefault(name, []).append(i)
    if any(is_opposite(heads[i]) for columns in named.values() for i in columns):
        # Two instruments in one head, the axis minus the laser: refused as it is read.
        return []
    if named and SURELY_TARGET.match(heads[target]):
        # Beside targets positions were read, by whatever.
        for i in (i for i, head in enumerate(heads) if i != target and _PLACES.match(head) and is_unit(unit[i])):
            named.setdefault(name_of(heads[i]), []).append(i)
    own = [name for name in named if OWN_SENSOR.search(name)]
    if len(own) == len(named) and own and not others:
        # Beside sensors of the axis itself stands what it is measured with, whatever its name.
        named |= unknown
    if not named or (
        others and not own and any(is_deviation(heads[i]) for columns in others.values() for i in columns)
    ):
        return []
    if others and len(own) == len(named):
        groups = {"": [i for columns in others.values() for i in columns]}
    elif len(named) + len(others) > 1 or own or (wide_of(heads) is None and long_of(heads) is None):
        groups = {**named, **others}
    else:
        return []
    every = {i for columns in (*named.values(), *others.values()) for i in columns}
    tables = []
    for name, columns in groups.items():
        kept = [i for i in range(len(heads)) if i not in every or i in columns]
        told = [_without_name(heads[i], unit[i]) if name and i in columns else heads[i] for i in kept]
        if wide_of(told) is None and long_of(told) is None:
            return []
        body = [[line[i] if i < len(line) else "" for i in kept] for line in (below[1:] if units and name else below)]
        if units and name:
            told = [
                told[k] if i in columns else f"{told[k]} [{unit[i]}]" if unit[i] else told[k]
                for k, i in enumerate(kept)
            ]
        tables.append(_ReportTable([told, *body], name))
    return tables


def _may_be_read(head: str) -> bool:
    return not (names_target(head) and not _INSTRUMENT.search(head)) and not (
        is_index(head) or SUMS_UP.search(head) or _DIFFERENCE.search(head)
    )


def _without_name(head: str, unit: str) -> str:
    """Return the head of a column of readings in the words of a plain table: ``deviation forward 1 [µm]``."""
    number = [word for word in re.findall(r"[^\W_]+", head) if word.isdigit()][-1:]
    return " ".join(["deviation" if is_deviation(head) else "actual", way_of(head) or "", *number, f"[{unit}]"])


def without_remarks(heads: Sequence[str], body: Sequence[Sequence[str]], target: int) -> list[Sequence[str]]:
    """Return the rows of a table without blank ones, heads that are repeated, titles above those, and what is written below the last target."""
    told = [cell.strip() for cell in heads]
    filled = [row for row in body if any(cell.strip() for cell in row)]
    again = [[cell.strip() for cell in row] == told for row in [*filled, ()]]
    title = [bool(_SERIES.fullmatch("".join(row))) and below for row, below in zip(filled, again[1:], strict=True)]
    rows = [row for row, head, above in zip(filled, again, title, strict=False) if not head and not above]
    whole = sum(bool(cell.strip()) for cell in rows[0]) if rows else 0
    while rows and _is_remark(rows[-1], target, whole):
        del rows[-1]
    return rows


def _is_remark(row: Sequence[str], target: int, whole: int) -> bool:
    """Return whether a row says something in words and is no target: of ``whole`` cells of a target's row it has few."""
    at = row[target].strip() if target < len(row) else ""
    worded = any(cell.strip()[:1].isalpha() and cell.strip().lower() not in MISSING for cell in row)
    return at[:1].isalpha() or (worded and (not at or 2 * sum(bool(cell.strip()) for cell in row) < whole))
