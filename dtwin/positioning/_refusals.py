"""What a table of readings along an axis cannot be: another test, angles, lengths in another unit than they seem to have."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dtwin.acquire.foreign_columns import REVERSED, in_english, unit_of_titles
from dtwin.errors import InputError
from dtwin.positioning._plain_table import table_of
from dtwin.positioning.position_runs import PositionTable
from dtwin.positioning.table_heads import (
    ANGLE,
    MOST_TITLES,
    OTHER_TEST,
    is_deviation,
    is_opposite,
    is_unit,
    scale_of,
    told_unit,
    unit_of,
    way_of,
)
from dtwin.units import UM_PER_MM

# Of the travel: no linear axis errs by so much.
LITTLE = 0.02
_LONGEST_MM = 1e5
_ANGLE_HEAD = re.compile(r"(\w+[ _-]?)?(angle|winkel|angular position|rotary position)\b", re.I)
_ARC = re.compile(r"\barc[ _-]?(sec|min)|[\[(]\s*(\"|\u2033|''|\u2032|'|秒)\s*[\])]|角秒|角分", re.I)


def require_positioning(rows: Sequence[Sequence[str]], path: Path) -> None:
    """Refuse a table whose title or heads say that it is of another test along an axis."""
    titles = [row[0] for row in rows[:MOST_TITLES] if row and not any(cell.strip() for cell in row[1:])]
    other = next((text.strip() for text in (*titles, *(table_of(rows) or [()])[0]) if OTHER_TEST.search(text)), None)
    require_sign([text for text in titles if REVERSED.search(text)], path)
    if other is not None:
        raise InputError(
            "title or heads say that this is no test of positioning",
            code="position_table.test",
            where=str(path),
            got=other[:60],
            allowed="linear positioning",
            hint="deviations across the axis, and angles, are not read",
        )


def require_near(table: PositionTable, path: Path) -> None:
    """Refuse what was taken for positions and does not follow its targets: deviations without a unit, most likely."""
    read_um = np.hstack([table.forward_um, table.reverse_um])
    there = np.isfinite(read_um).any(axis=1)
    travel_mm = float(np.ptp(table.target_mm))
    if travel_mm > _LONGEST_MM:
        raise InputError(
            "targets lie farther apart than any machine travels",
            code="position_table.unit",
            where=str(path),
            got=f"{travel_mm:z.6g} mm",
            allowed=f"up to {_LONGEST_MM:g} mm",
            hint="write the unit into the head, such as: target [µm]",
        )
    target_mm, off_mm = table.target_mm[there], np.nanmean(read_um[there], axis=1) / UM_PER_MM
    against_mm = 2.0 * target_mm + off_mm
    if table.by_position and np.ptp(against_mm) < LITTLE * np.ptp(table.target_mm):
        raise InputError(
            "the readings run against the targets: the scale or the instrument counts the other way",
            code="position_table.mirrored",
            where=str(path),
            got=f"{target_mm[0] + off_mm[0]:z.6g} to {target_mm[-1] + off_mm[-1]:z.6g} mm at targets of {target_mm[0]:z.6g} to {target_mm[-1]:z.6g} mm",
            allowed="readings that grow as the targets do",
            hint="change the sign of all readings, or of all targets where those count the other way",
        )
    if table.by_position and np.median(np.abs(off_mm - np.median(off_mm))) > LITTLE * np.ptp(table.target_mm):
        raise InputError(
            "the readings are taken for positions, and do not follow their targets",
            code="position_table.unit",
            where=str(path),
            got=f"{target_mm[-1] + off_mm[-1]:z.6g} mm at a target of {target_mm[-1]:z.6g} mm",
            allowed="positions; or deviations whose heads say so and state the unit",
            hint="write the unit of deviations into their heads, such as: forward 1 [µm]",
        )


def require_lengths(rows: Sequence[Sequence[str]], path: Path) -> None:
    """Refuse a table of angles: its figures would be taken for lengths."""
    angles = [cell.strip() for row in rows for cell in row if ANGLE.search(cell.strip())]
    if angles:
        raise of_angles(path, angles[0][:40])


def require_sign(titles: Sequence[str], path: Path) -> None:
    """Refuse a table with a title or head which says that errors are nominal minus actual, or with corrections."""
    if opposite := next((text.strip() for text in titles if is_opposite(text)), ""):
        raise InputError(
            "a column holds corrections or nominal minus actual: its sign is not that of a deviation",
            code="position_table.sign",
            where=str(path),
            got=opposite[:60],
            allowed="actual minus target",
            hint="change the sign and call the column a deviation",
        )


def require_no_turns(rows: Sequence[Sequence[str]], path: Path) -> None:
    """Refuse the table of an axis that turns: angles as targets, directions or seconds of arc beside them, and no length."""
    for row, below in zip(rows[:MOST_TITLES], [*rows[1:], ()], strict=False):
        heads = [in_english(cell) for cell in row]
        angle = next((head for head in heads if _ANGLE_HEAD.match(head)), "")
        others = [head for head in heads if head != angle]
        ways, arc = sum(way_of(head) is not None for head in others), any(map(_ARC.search, (*others, *below)))
        read = ways or any(map(is_deviation, others))
        if (
            angle
            and (ways > 1 or (arc and read))
            and not any(unit_of(cell) or is_unit(cell) for cell in (*heads, *below))
        ):
            raise of_angles(path, ", ".join(row)[:80])


def of_angles(path: Path, got: str) -> InputError:
    """Return the refusal of a table of angles."""
    return InputError(
        "the table is in angles, and only linear axes are judged",
        code="position_table.unit",
        where=str(path),
        got=got,
        allowed="mm, µm, nm, in",
        hint="positioning of a rotary axis is not evaluated here; where the axis is a linear one of this name, write [mm] into the heads",
    )


def require_unit_of_heads(rows: Sequence[Sequence[str]], table: Sequence[Sequence[str]], path: Path) -> None:
    """Refuse a table whose heads tell no unit, and whose title tells another than mm: of which columns it is, nobody knows."""
    unit = unit_of_titles(rows[:MOST_TITLES])
    heads = any(told_unit(cell, "") or is_unit(cell) for row in table[:2] for cell in row)
    if not heads and scale_of(unit) != 1.0:
        raise InputError(
            "a title tells a unit, and no head says that it is in it",
            code="position_table.unit",
            where=str(path),
            got=unit,
            allowed="a unit in the heads; without any, targets and positions are millimetres",
            hint=f"write it into the heads of the columns that are in it, such as: forward 1 [{unit}]",
        )
