"""Readings at several speeds, or of several runs, that stand in blocks below or beside each other, as one table."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

from dtwin.acquire.foreign_columns import all_units
from dtwin.acquire.table_dialect import SUMMARY
from dtwin.acquire.xmlsafe import number_or_none
from dtwin.kinds.rotation._heads import SPEED, Column, column_of

REPEAT = re.compile(
    r"[\s_.#-]*(?<![^\W_])(run(?!\W*out)|turn|umdrehung|trial|repeat|repetition|messung|messreihe|durchgang|lauf|test|essai|misura|medida|operator|pr[üu]fer|inspector)[\s_.#-]*\d*(?![^\W_])",
    re.I,
)
"""In the head of a column: which of several readings of one probe it holds."""
SPEED_ABOVE = re.compile(r"([\d.]+)\s*(rpm|1/min|min-1|u/min|r/min|tr/min)", re.I)
"""Head of a column at one speed."""
_SPEED_TITLE = re.compile(
    rf"(?!.*\b(max|minim|rated|nenn|limit))(.*(speed|drehzahl|vitesse|velocid|velocit|回転|转速)[^\d\n]*|\bn\s*=\s*|\W*){SPEED_ABOVE.pattern}\W*",
    re.I,
)
"""Title of a table at one speed."""
_LONGEST_TITLE = 200
_GROUPED = re.compile(r"\d{1,3}[.,]\d{3}")


def below_speeds(rows: Sequence[Sequence[str]]) -> list[Sequence[str]]:
    """Return tables below titles such as ``Speed: 1000 rpm`` as one, with a column of speeds; other rows as they are."""
    above: list[Sequence[str]] = []
    table: list[Sequence[str]] = []
    speed = ""
    for row in rows:
        told = [cell.strip() for cell in row if cell.strip()]
        said = " ".join(told)
        title = _SPEED_TITLE.fullmatch(said) if len(said) <= _LONGEST_TITLE else None
        if title is None and not speed:
            above.append(row)
            continue
        words = not any(number_or_none(cell) is not None for cell in told)
        if title is not None:
            number, unit = title[4], title[5]
            # No speed is told to a thousandth of a turn.
            number = re.sub(r"[.,]", "", number) if _GROUPED.fullmatch(number) else number
            speed = f"{column_of('speed', unit).factor * float(number):g}"
        elif not table:
            table = [[*row, "speed [rpm]"]] if words and len(told) > 1 else []
        elif len(table) == 1 and all_units(row):
            table.append([*row, ""])
        elif words and len(told) > 1 and [*row] not in [[*line[:-1]] for line in table[:2]]:
            # Other heads: these are no blocks of one table.
            return list(rows)
        elif not words and not any(map(SUMMARY.fullmatch, told)):
            width = len(table[0]) - 1
            table.append([*row[:width], *[""] * (width - len(row)), speed])
    if len(table) < 2 or any(column_of(cell).role == SPEED for cell in table[0][:-1]):
        return list(rows)
    return [*above, *table]


def repeats_below(
    heads: Sequence[str], columns: list[Column], probes: Sequence[int], body: Sequence[Sequence[str]]
) -> tuple[list[Column], list[int], list[Sequence[str]]]:
    """Return a table whose columns of one probe, ``run 1``, ``run 2``, stand as rows below each other: they are repeats."""
    alike: dict[str, list[int]] = {}
    for n in probes:
        if REPEAT.search(heads[n]):
            alike.setdefault(REPEAT.sub("", heads[n]), []).append(n)
    first = {group[0]: group for group in alike.values() if len(group) > 1}
    if not first:
        return columns, list(probes), list(body)
    others = {n for group in first.values() for n in group[1:]}
    named = [
        replace(c, name=REPEAT.sub("", c.name).strip("_") or c.name) if n in first else c for n, c in enumerate(columns)
    ]
    out: list[Sequence[str]] = []
    for k in range(max(map(len, first.values()))):
        for row in body:
            cells = [cell if k == 0 or n not in probes else "" for n, cell in enumerate(row)]
            for n, group in first.items():
                if n < len(cells):
                    cells[n] = cell_of(row, group[k]) if k < len(group) else ""
            out.append(cells)
    return named, [n for n in probes if n not in others], out


def cell_of(row: Sequence[str], n: int) -> str:
    """Return a cell of a row without blanks; empty where the row has none."""
    return row[n].strip() if n < len(row) else ""
