"""Positioning tests as assignments: ``TGT_DATA[1]=15``, ``REF_DATA_FWD[1,1]=15.01``, ``UNIT=mm``; and a reading of any form."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from dtwin.acquire.xmlsafe import number_or_none
from dtwin.errors import InputError
from dtwin.positioning.ways import Scale

_ASSIGNED = re.compile(r"^\s*(TGT_DATA|REF_DATA_FWD|REF_DATA_BWD)\[(\d+)(?:,(\d+))?\]\s*=\s*(\S+)\s*$")
_UNIT_ASSIGNED = re.compile(r"^\s*UNIT\s*=\s*(\S+)\s*$", re.M)

Reading = tuple[float, str, int, float, bool]
"""Target, direction, cycle from 1, deviation, and whether it follows from a position; in the units of a scale."""


def is_assigned(text: str) -> bool:
    """Return whether a text holds such assignments."""
    return any(_ASSIGNED.match(line) for line in text.splitlines())


def assigned_unit(text: str) -> str:
    """Return the unit of a text of assignments; empty where it states none."""
    stated = _UNIT_ASSIGNED.search(text)
    return stated[1].lower() if stated else ""


def assigned_readings(text: str, path: Path, scale: Scale) -> list[Reading]:
    """Return the readings of a text. Raises ``InputError`` when a unit or a target is not told."""
    unit = assigned_unit(text) or scale.unit
    if unit not in scale.units:
        raise wrong_form("a unit that is not known", path, unit[:20])
    targets: dict[int, float] = {}
    read: list[tuple[str, int, int, float]] = []
    for number, line in enumerate(text.splitlines(), start=1):
        match = _ASSIGNED.match(line)
        if match is None:
            continue
        value = _number_of(match[4], f"{path} line {number}") * scale.units[unit]
        if match[1] == "TGT_DATA":
            targets[int(match[2])] = value
        elif match[3] is None:
            raise wrong_form("a reading without a cycle", path, line.strip()[:60])
        else:
            read.append(("forward" if match[1].endswith("FWD") else "reverse", int(match[2]), int(match[3]), value))
    lost = sorted({point for _, point, _, _ in read} - set(targets))
    if lost:
        raise wrong_form("readings of a target that is not told", path, f"number {lost[0]}")
    return [(targets[p], way, cycle, (value - targets[p]) * scale.per, True) for way, p, cycle, value in read]


def _number_of(cell: str, where: str) -> float:
    """Return a number that a cell holds; refuse what is none."""
    value = number_or_none(cell)
    if value is None or abs(value) > 1e9:
        raise InputError(
            "not a number",
            code="position_table.number",
            where=where,
            got=cell[:40] or "nothing",
            allowed="a finite number; an empty cell, -, nan or n/a where nothing was read; angles such as 12°30'05\"",
            hint="units of single numbers belong into the heads, such as: forward 1 [″], forward 1 [µm]"
            if cell.strip()
            else "a target, or a cycle, of merged cells belongs into each of their rows",
        )
    return value


def number_in(row: Sequence[str], i: int, where: str) -> float:
    """Return the number of a column of a row; an empty text stands for a cell that is not there."""
    return _number_of(row[i] if i < len(row) else "", where)


def wrong_form(message: str, path: Path, got: str) -> InputError:
    """Return the refusal of a table, with the forms that are read."""
    return InputError(
        message,
        code="position_table.form",
        where=str(path),
        got=got,
        allowed="targets with columns such as forward 1, reverse 1; or target, cycle, forward, reverse; or target, direction, "
        "cycle, deviation; or TGT_DATA[1]=, REF_DATA_FWD[1,1]=",
        hint="docs/how-to/positioning-table.md",
    )
