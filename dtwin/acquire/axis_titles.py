"""Titles that name an axis, above tables in a text or of the sheets of a workbook, and the choice of one of them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from dtwin.acquire.foreign_columns import is_number
from dtwin.errors import InputError

_AXIS = r"(?:(?:mess)?(?:axis|achse)|axe|asse|eje)"
_TITLE = re.compile(
    rf"(?:{_AXIS}[\s.:_#-]*([xyzabcuvw]\d?|\d)|([xyzabcuvw]\d?|\d)[\s._-]*{_AXIS})(?:[\s,:;(-].*)?", re.I
)
_WITHIN = re.compile(rf"(?<!\w)(?:{_AXIS}[\s.:_#-]*([xyzabcuvw]\d?)|([xyzabcuvw]\d?)[\s._-]*{_AXIS})(?!\w)", re.I)
_IN_HEAD = re.compile(
    r"(?<![^\W_])[xyz](?![^\W_])(?=.*[a-z]{2})|(?<=\w )[xyz](?![^\W_])|(?<=\w )[abc](?=\s*[\[(]\s*(?:°|deg))", re.I
)
"""Beside other words of a head."""
AXIS_OF_ROW = re.compile(rf"{_AXIS}|coordinate|koordinate|component|komponente", re.I)
"""Head of a column that says of which axis a row is."""
_MOST_TITLES = 20
_BARE = re.compile(r"[xyzabcuvw]\d?", re.I)
AXIS_CHOSEN = "file.axis"
"""Code of the finding that the file holds other axes, too: a run of it cannot be called one of another axis afterwards."""
_POSE = re.compile(r"pose([\s_.]*(no|nr|number|nummer|id|name|#))?\.?", re.I)
_CELLS = re.compile(r"[;\t|]")
_MARKS = "#*|=-,;:\t \"'"


def axis_of(title: str, *, bare: bool = False) -> str:
    """Return the axis that a title begins with, ``X`` of ``X axis`` and ``Achse: X``, in capitals; empty where it names none.

    ``bare``: a letter alone is an axis, too, as the name of a sheet.
    """
    told = title.strip(_MARKS)
    match = _TITLE.fullmatch(told)
    if match is not None:
        return (match[1] or match[2]).upper()
    return told.upper() if bare and _BARE.fullmatch(told) else ""


def axes_named(rows: Sequence[Sequence[str]], axis: str) -> list[str]:
    """Return the axis that titles name within other words, ``Y`` of ``Accuracy of the Y axis``, or in a cell of its own, ``Axis;Y``, and else that of all heads that name one, ``Y fwd 1 [µm]``; none where they name several.

    ``axis``: asked for; of one that moves along heads name no instrument by an axis that turns, nor the other way round.
    """
    cells = [[cell.strip() for cell in row if cell.strip()] for row in rows]
    titles = [told[0] for told in cells if len(told) == 1]
    titles += [" ".join(told) for told in cells if len(told) == 2 and _BARE.fullmatch(told[1])]
    heads = [cell for told in cells if len(told) > 2 and not any(map(is_number, told)) for cell in told]
    told = {(m[1] or m[2]).upper() for title in titles for m in _WITHIN.finditer(title)}
    alike = next((names for names in ("XYZ", "ABC") if axis[:1].upper() in names), "")
    told = told or {m[0].upper() for head in heads for m in _IN_HEAD.finditer(head) if m[0].upper() in alike}
    return sorted(told) if len(told) == 1 else []


def parts_by_axis(text: str) -> dict[str, str]:
    """Return the tables of a text that stand below titles of several axes, with what stands above the first; empty where there are no two."""
    parts = _parts(text)
    return parts if len(parts) > 1 else {}


def _parts(text: str) -> dict[str, str]:
    above: list[str] = []
    parts: dict[str, list[str]] = {}
    lines = above
    for line in text.splitlines():
        # A row of a table has several cells; commas stand in titles, too.
        row = sum(bool(cell.strip()) for cell in _CELLS.split(line)) > 1 or any(map(is_number, line.split(",")))
        axis = "" if row else axis_of(line)
        if axis:
            lines = parts.setdefault(axis, [])
        else:
            lines.append(line)
    return {axis: "\n".join([*above, *lines]) for axis, lines in parts.items()}


def part_of_axis(text: str, axis: str, path: Path) -> str:
    """Return the part of a text that stands below the title of an axis; a text without titles of several as it is.

    Raises ``InputError`` when the axis that is asked for is none of those, or not the one that the title tells.
    """
    parts = _parts(text)
    require_axis(list(parts), axis, path)
    return parts[axis.upper()] if len(parts) > 1 else text


def require_axis(told: Sequence[str], axis: str, path: Path) -> None:
    """Refuse an axis that is none of those that a file tells; a lone number, or a letter more, is no other axis."""
    several, asked, one = len(told) > 1, axis.upper(), next(iter(told), "")
    if (asked not in told) if several else bool(one) and not one.isdigit() and asked[:1] not in ("", one[:1]):
        raise InputError(
            "the file holds tables of several axes, and none of the one that is asked for"
            if several
            else "the table says that it is of another axis",
            code="position_table.axes",
            where=str(path),
            got=f"axis {axis or 'not told'}; in the file {', '.join(told)}"[:80],
            allowed="one of them, one campaign each" if several else "the axis that was measured",
            hint=f"--axis {one}",
        )


def axis_by_row(rows: Sequence[Sequence[str]]) -> tuple[int, int] | None:
    """Return the row of the heads and the column of the axis in a table whose rows tell X, Y and Z of one place after the other, or that names poses; None of another."""
    for begin, row in enumerate(rows[:_MOST_TITLES]):
        axis = next((n for n, cell in enumerate(row) if AXIS_OF_ROW.fullmatch(cell.strip())), None)
        if axis is not None:
            below = [line[axis].strip().upper() for line in rows[begin + 1 : begin + 6] if axis < len(line)]
            told = [cell for cell in below if cell in ("X", "Y", "Z")][:3]
            return (begin, axis) if len(set(told)) == 3 or any(_POSE.fullmatch(cell.strip()) for cell in row) else None
    return None
