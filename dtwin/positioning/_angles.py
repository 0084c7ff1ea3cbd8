"""Tables of an axis that turns: how they are known, and heads of angles as those of targets."""

from __future__ import annotations

import re
from collections.abc import Sequence

from dtwin.acquire.foreign_columns import in_english
from dtwin.acquire.table_dialect import rows_of
from dtwin.positioning.table_heads import (
    ANGLE,
    MOST_TITLES,
    NAMED,
    is_deviation,
    is_length,
    names_target,
    plain_unit,
    told_unit,
    way_of,
)
from dtwin.units import ANGLES_DEG

_ANGLE_HEAD = re.compile(r"(\w+[ _-]?)?(angle|winkel|angular position|rotary position)\b", re.I)


def angles_as_targets(text: str) -> str:
    """Return a text whose heads of angles, ``Winkel [°]``, say that they are targets, ``target: Winkel [°]``, where the heads beside are of a positioning test.

    They are where several name a direction, or hold deviations in a unit of angle, and none is in a unit of length.
    """
    rows = rows_of(text)
    for row, below in zip(rows[:MOST_TITLES], [*rows[1:], ()], strict=False):
        at = next((i for i, cell in enumerate(row) if _ANGLE_HEAD.match(in_english(cell))), -1)
        others = [in_english(cell) for i, cell in enumerate(row) if i != at]
        small = any(map(_in_angles, (*others, *(cell for i, cell in enumerate(below) if i != at))))
        read = any(way_of(cell) or is_deviation(cell) for cell in others)
        ways = sum(way_of(cell) is not None for cell in others)
        if at >= 0 and (ways > 1 or (small and read)) and not any(map(is_length, (*row, *below))):
            head = row[at].strip()
            return re.sub(rf"(?<!\w){re.escape(head)}(?!\w)", f"{NAMED}{in_english(head)}", text)
    return text


def of_angles(rows: Sequence[Sequence[str]]) -> bool:
    """Return whether the targets of a table say that they are angles, in their head or below it, and nothing says that it is a length.

    Deviations alone do not tell it: tilts of what moves along an axis are angles, too.
    """
    heads, below = rows[0], rows[1] if len(rows) > 1 else ()
    targets = [i for i, head in enumerate(heads) if names_target(head)]
    cells = [row[i].strip() for i in targets for row in (heads, below) if i < len(row)]
    told = any(is_angle(cell) or _ANGLE_HEAD.match(cell.removeprefix(NAMED)) for cell in cells)
    return told and not any(map(is_length, (*heads, *below)))


def is_angle(cell: str) -> bool:
    """Return whether a cell tells a unit of angle that is surely one: ``"`` alone may be one of length."""
    return ANGLE.search(cell) is not None or (_in_angles(cell) and '"' not in cell)


def _in_angles(cell: str) -> bool:
    return plain_unit(told_unit(cell, "")) in ANGLES_DEG or plain_unit(cell) in ANGLES_DEG
