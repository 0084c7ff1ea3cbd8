"""Tables of poses with a row for each axis, ``pose, axis, target [mm], measured [mm]``: the three rows of a pose become one."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

from dtwin.acquire.axis_titles import AXIS_OF_ROW, axis_by_row
from dtwin.acquire.foreign_columns import below_heads, in_english
from dtwin.errors import InputError
from dtwin.kinds.poses._foreign import of_words
from dtwin.kinds.poses._repeats import COUNTS, PLACES

_MOST_TITLES = 20
_XYZ = ("X", "Y", "Z")
_UNIT = re.compile(r"(\s*[\[(/].*|_[mnµu]?m)?$")
_Rows = Sequence[Sequence[str]]


def axes_beside(rows: _Rows, path: Path) -> _Rows:
    """Return a table whose axes stand beside each other; another one as it is.

    Raises ``InputError`` when rows of axes do not make poses of X, Y and Z each.
    """
    found = _found(rows)
    if found is None:
        return rows
    begin, axis, heads, units, body = found
    values = [n for n, head in enumerate(heads) if n != axis and _of_axis(head, "X") is not None]
    kept = [n for n in range(len(heads)) if n != axis and n not in values]
    keys = [n for n in kept if PLACES.fullmatch(heads[n]) or COUNTS.fullmatch(heads[n])]
    told = [f"{heads[n]} [{units[n]}]" if n < len(units) and units[n].strip() else heads[n] for n in range(len(heads))]
    names = [told[n] for n in kept] + [str(_of_axis(told[n], letter)) for n in values for letter in _XYZ]
    made: list[Sequence[str]] = [*rows[:begin], names]
    for pose in _poses(body, axis, keys, path):
        by_axis = {row[axis].strip().upper(): row for row in pose}
        made.append([*(pose[0][n] for n in kept), *(by_axis[letter][n] for n in values for letter in _XYZ)])
    return made


def is_by_axes(rows: _Rows) -> bool:
    """Return whether a table begins with the rows of the three axes of a pose, commanded and measured."""
    begin = axis_by_row(rows)
    said = [_of_axis(head.strip(), "X") for head in rows[begin[0]]] if begin is not None else []
    return {"target"} < {of_words(head).partition("_")[0] for head in said if head is not None}


def _found(rows: _Rows) -> tuple[int, int, list[str], Sequence[str], list[list[str]]] | None:
    """Return the row of the heads, the column of the axis, heads, units below them, and rows; None of another table."""
    for begin, row in enumerate(rows[:_MOST_TITLES]):
        heads = [cell.strip() for cell in row]
        axis = next((n for n, head in enumerate(heads) if AXIS_OF_ROW.fullmatch(head)), None)
        if axis is None:
            continue
        units, below = below_heads([list(line) for line in rows], begin)
        body = [line for line in below if len(line) == len(heads) and any(cell.strip() for cell in line)]
        letters = {line[axis].strip().upper() for line in body}
        if body and letters <= set(_XYZ) and len(letters) > 1 and any(_of_axis(head, "X") for head in heads):
            return begin, axis, heads, units or (), body
    return None


def _of_axis(head: str, letter: str) -> str | None:
    """Return the head of one axis, ``target [mm]`` as ``target X [mm]``; None of a column that is no place."""
    said = _UNIT.sub(lambda unit: f" {letter}{unit[0]}", in_english(head), count=1)
    return said if of_words(said) != said else None


def _poses(body: list[list[str]], axis: int, keys: Sequence[int], path: Path) -> list[list[list[str]]]:
    """Return the rows of each pose: three that follow each other, or that have one name and number."""

    def whole(pose: list[list[str]]) -> bool:
        letters = sorted(row[axis].strip().upper() for row in pose)
        return letters == list(_XYZ) and len({tuple(row[n].strip() for n in keys) for row in pose}) == 1

    following = [body[n : n + 3] for n in range(0, len(body), 3)]
    if all(map(whole, following)):
        return following

    def key(row: list[str]) -> tuple[str, ...]:
        return tuple(row[n].strip() for n in keys)

    first = {name: n for n, name in reversed(list(enumerate(map(key, body))))}
    named = [list(pose) for _, pose in groupby(sorted(body, key=lambda row: first[key(row)]), key)] if keys else []
    if named and all(map(whole, named)):
        return named
    wrong = next(pose for pose in (named or following) if not whole(pose))
    raise InputError(
        "rows of axes do not make poses",
        code="poses.axes",
        where=str(path),
        got="; ".join(", ".join(cell.strip() for cell in row) for row in wrong[:4])[:160],
        allowed="a row of X, of Y and of Z for each pose, one after the other, or with the pose's name and number of repeat",
        hint="or one row a pose: target_x_mm, target_y_mm, target_z_mm, measured_x_mm, …",
    )
