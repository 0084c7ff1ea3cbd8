"""Tables of an axis that turns: how they are known, and heads of angles as those of targets."""

from __future__ import annotations

import re
from collections.abc import Sequence

from dtwin.acquire.foreign_columns import in_english, is_number
from dtwin.acquire.table_dialect import rows_of
from dtwin.positioning.table_heads import (
    ANGLE,
    CYCLE,
    MISSING,
    MOST_TITLES,
    NAMED,
    SURELY_READ,
    is_deviation,
    is_length,
    names_target,
    plain_unit,
    told_unit,
)
from dtwin.positioning.ways import way_of
from dtwin.units import ANGLES_DEG

# Lines: heads are among the first rows, and a comment may stand above them.
_FIRST = 200
_ANGLE_HEAD = re.compile(r"(\w+[ _-]?)?(angle|winkel|angular position|rotary position)\b", re.I)

_NUMBER = r"(\d+(?:\.\d+)?)\s*"
_PARTS = re.compile(
    rf"([+\-\u2212]?)\s*(?:{_NUMBER}°\s*)?(?:{_NUMBER}['\u2032\u2019]\s*)?(?:{_NUMBER}(?:[\"\u2033\u201d]|''|\u2032\u2032|\u2019\u2019))?"
)


def with_degrees(rows: Sequence[Sequence[str]]) -> list[list[str]]:
    """Return a table whose cells in degrees, minutes and seconds, ``12°30'05"``, are numbers: in the unit of their head, or in degrees, which it says then."""
    out = [list(row) for row in rows]
    seen: dict[int, float] = {}
    # Alone, ``2.5"`` may be a length.
    surely = any("°" in cell and _degrees(cell) is not None for row in rows for cell in row)
    for n, row in enumerate(rows if surely else ()):
        for i, cell in enumerate(row):
            degrees = _degrees(cell)
            if degrees is None:
                continue
            if i not in seen:
                above = (line for line in reversed(out[:n]) if i < len(line))
                row_of_head = next((line for line in above if _is_head(line[i])), None)
                head = "" if row_of_head is None else row_of_head[i]
                seen[i] = ANGLES_DEG.get(plain_unit(told_unit(head, "")), 0.0)
                if row_of_head is not None and not seen[i]:
                    row_of_head[i] = f"{head.partition('[')[0].strip()} [°]"
            out[n][i] = repr(degrees / (seen[i] or 1.0))
    return out


def _is_head(cell: str) -> bool:
    return cell.strip().lower() not in MISSING and not is_number(cell)


def _degrees(cell: str) -> float | None:
    """Return an angle in degrees, minutes and seconds; None of another cell."""
    match = _PARTS.fullmatch(cell.strip())
    if match is None or not any(match.groups()[1:]):
        return None
    degrees, minutes, seconds = (float(part or 0) for part in match.groups()[1:])
    if (match[2] and (minutes >= 60.0 or ((match[3] or match[4]) and degrees % 1.0))) or (
        (match[2] or match[3]) and seconds >= 60.0
    ):
        return None
    return (1.0 if match[1] in ("", "+") else -1.0) * (degrees + minutes / 60.0 + seconds / 3600.0)


def angles_as_targets(text: str) -> str:
    """Return a text whose heads of angles, ``Winkel [°]``, say that they are targets, ``target: Winkel [°]``, where the heads beside are of a positioning test.

    They are where several name a direction, or hold deviations or runs in a unit of angle, and none is in a unit of length.
    """
    written = rows_of("\n".join(text.splitlines()[:_FIRST]))
    rows = with_degrees(written)
    for n, (row, below) in enumerate(zip(rows[:MOST_TITLES], [*rows[1:], ()], strict=False)):
        at = next((i for i, cell in enumerate(row) if _ANGLE_HEAD.match(in_english(cell))), -1)
        others = [in_english(cell) for i, cell in enumerate(row) if i != at]
        small = any(map(_in_angles, (*others, *(cell for i, cell in enumerate(below) if i != at))))
        runs = (cell for cell in others if CYCLE.match(cell) or SURELY_READ.match(cell))
        read = any(way_of(cell) or is_deviation(cell) for cell in others) or any(map(_in_angles, runs))
        ways = sum(way_of(cell) is not None for cell in others)
        if at >= 0 and (ways > 1 or (small and read)) and not any(map(is_length, (*row, *below))):
            head = written[n][at].strip()
            named = f"{NAMED}{in_english(head)}".replace("\\", r"\\")
            return re.sub(rf"(?<!\w){re.escape(head)}(?!\w)", named, text)
    return text


def of_angles(rows: Sequence[Sequence[str]]) -> bool:
    """Return whether the targets of a table say that they are angles, in their head or below it, and nothing says that it is a length.

    Deviations alone do not tell it: tilts of what moves along an axis are angles, too.
    """
    heads, below = rows[0], rows[1] if len(rows) > 1 else ()
    targets = [i for i, head in enumerate(heads) if names_target(head)]
    cells = [row[i].strip() for i in targets for row in (heads, below) if i < len(row)]
    told = any(_is_angle(cell) or _ANGLE_HEAD.match(cell.removeprefix(NAMED)) for cell in cells)
    return told and not any(map(is_length, (*heads, *below)))


def _is_angle(cell: str) -> bool:
    """Return whether a cell tells a unit of angle that is surely one: ``"`` alone may be one of length."""
    return ANGLE.search(cell) is not None or (_in_angles(cell) and '"' not in cell)


def _in_angles(cell: str) -> bool:
    return plain_unit(told_unit(cell, "")) in ANGLES_DEG or plain_unit(cell) in ANGLES_DEG


def tells_angles(rows: Sequence[Sequence[str]]) -> bool:
    """Return whether cells tell a unit of angle, and none a unit of length."""
    cells = [cell for row in rows for cell in row]
    return any(map(names_angles, cells)) and not any(map(is_length, cells))


def names_angles(title: str) -> bool:
    """Return whether a title tells a unit of angle; ``20.3 °`` is one value of something."""
    return _is_angle(title) and re.search(r"\d\s*°", title) is None
