"""Readings of several instruments beside each other in a plain table: laser and encoder, one column or one set of columns each."""

from __future__ import annotations

import re
from collections.abc import Sequence

from dtwin.positioning._report_tables import DIFFERENCE, ReportTable, name_of
from dtwin.positioning.table_heads import (
    MOST_TITLES,
    OTHER_TEST,
    OWN_SENSOR,
    SUMS_UP,
    SURELY_READ,
    is_deviation,
    is_index,
    is_length,
    is_row_of_units,
    is_unit,
    long_of,
    names_target,
    told_unit,
    wide_of,
)
from dtwin.positioning.ways import way_of

_INSTRUMENT = re.compile(
    rf"laser|interferom|\b(xl|xm)-?\d|tracker|taster|\bprobe|messuhr|dial|indicator|lvdt|grid|gauge|(glas|linear|ma(ß|ss)).?s(cale|tab)|{OWN_SENSOR.pattern}",
    re.I,
)
_READ = re.compile(
    r"act|actual|measured|measurement|reading|value|wert|messwert|ist|istwert|istposition|position|pos|of|by|(dev|err|abw|fehler)\w*",
    re.I,
)
"""Words of a head that say that something was read, not by what."""


def instruments_beside(rows: Sequence[Sequence[str]]) -> list[ReportTable]:
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


def _of_heads(heads: Sequence[str], below: Sequence[Sequence[str]]) -> list[ReportTable]:
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
    own = [name for name in named if OWN_SENSOR.search(name)]
    if len(own) == len(named) and own and not others:
        # Beside sensors of the axis itself stands what it is measured with, whatever its name.
        named |= unknown
    if not named or (others and not own and any(is_deviation(heads[i]) for found in others.values() for i in found)):
        return []
    if others and len(own) == len(named):
        groups = {"": [i for found in others.values() for i in found]}
    elif len(named) + len(others) > 1 or own or (wide_of(heads) is None and long_of(heads) is None):
        groups = {**named, **others}
    else:
        return []
    every = {i for found in (*named.values(), *others.values()) for i in found}
    tables = []
    for name, found in groups.items():
        kept = [i for i in range(len(heads)) if i not in every or i in found]
        told = [_without_name(heads[i], unit[i]) if name and i in found else heads[i] for i in kept]
        if wide_of(told) is None and long_of(told) is None:
            return []
        body = [[line[i] if i < len(line) else "" for i in kept] for line in (below[1:] if units and name else below)]
        if units and name:
            told = [
                told[k] if i in found else f"{told[k]} [{unit[i]}]" if unit[i] else told[k] for k, i in enumerate(kept)
            ]
        tables.append(ReportTable([told, *body], name))
    return tables


def _may_be_read(head: str) -> bool:
    return not (names_target(head) and not _INSTRUMENT.search(head)) and not (
        is_index(head) or SUMS_UP.search(head) or DIFFERENCE.search(head)
    )


def _without_name(head: str, unit: str) -> str:
    """Return the head of a column of readings in the words of a plain table: ``deviation forward 1 [µm]``."""
    number = [word for word in re.findall(r"[^\W_]+", head) if word.isdigit()][-1:]
    return " ".join(["deviation" if is_deviation(head) else "actual", way_of(head) or "", *number, f"[{unit}]"])
