"""Which way round a table of a circle was measured: by heads, by a column of directions, by the titles above its blocks."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import lru_cache
from itertools import chain, pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dtwin.acquire.foreign_columns import DEVIATION, PROBES, Column, in_english
from dtwin.errors import InputError
from dtwin.schema import Direction, Finding, Floats
from dtwin.units import shown_number

_CLOCK = r"(clock[- ]?wise|uhrzeiger(sinn|richtung)?|\bi?uzs?\b|(sens[- ])?horaire|h?orario)"
_AGAINST = r"(sens[- ])?(counter|anti|against|contra|contre|contro|entgegen|gegen|inverse?|not|non|nicht)([- ]*(dem|den|des|du|al|the|to|sens))*[- ]*"
_SPELT = (
    (re.compile(r"\bguzs?\b|↺", re.I), "ccw"),
    (re.compile("↻"), "cw"),
    (re.compile(rf"{_AGAINST}({_CLOCK}|cw\b)", re.I), "ccw"),
    (re.compile(rf"(im )?{_CLOCK}", re.I), "cw"),
    # The probe on the left is no direction.
    (re.compile(rf"^(?!.*({PROBES})).*\b(left|links(lauf|herum|drehend)?)(?![^\W\d_]).*"), "ccw"),
    (re.compile(rf"^(?!.*({PROBES})).*\b(right|rechts(lauf|herum|drehend)?)(?![^\W\d_]).*"), "cw"),
)
"""How a direction is spelt out, those against the clock first: their names hold the others."""
_WAYS = {"ccw": "CCW", "acw": "CCW", "g03": "CCW", "g3": "CCW", "cw": "CW", "g02": "CW", "g2": "CW"}
_DIRECTION = re.compile(
    r"(.*[\s-])?(direction|dir|\w*richtung|\w*sinn|sens(e|o)?|sentido|rotation|way|\w*方向)\.?( (of|de|di) \w+| code)?",
    re.I,
)
_SIDES = re.compile(r"left|right|links|rechts|^cw\d\d$")
"""In a cell of any column: a side, or a week."""

_BACK_DEG = 20.0
"""How far an angle runs back where the direction changes."""
_FEWEST, _MOST_PARTS = 18, 1000
"""Rows of a run, and runs of a table."""
_STANDS = 5
"""Rows at one place of a machine that stands."""
_COARSE_UM = (1000.0, 100.0, 10.0, 1.0)
"""Steps of coordinates that hide what is told of a circle."""
_RUN = re.compile(
    r"(run|repeat|repetition|lauf|durchgang|messung|messreihe|wiederholung|test|circle|kreis|cycle|zyklus|pass|series?|serie|essai|prova|prueba)( ?(no|nr|number|nummer|id)\.?)?",
    re.I,
)


def bare(column: Column) -> str:
    """Return a head without its unit, in small letters, with blanks."""
    base = re.sub(r"[\[(].*?[\])]", "", in_english(column.head)).strip()
    base = re.sub(rf"(\s+in\s+|\s*/\s*|\s+){re.escape(column.unit)}$", "", base) if column.unit else base
    return re.sub(r"[_\s]+", " ", base.removesuffix(f"_{column.unit}")).strip().lower()


def deviates(column: Column) -> bool:
    """Return whether a column holds deviations of whatever direction."""
    return column.head == "deviation_um" or DEVIATION.match(bare(column)) is not None


def blocks(
    columns: Sequence[Column], above: Sequence[Sequence[str]], body: Sequence[Sequence[str]]
) -> Sequence[tuple[Direction | None, NDArray[np.bool_]]]:
    """Return which rows were measured in one go, with the direction that a column of directions, or the title above them, tells.

    A column that counts runs parts them, too. Where directions or runs alternate from row to row, the rows of each belong together.
    """
    counted = run_column(columns)
    of_run = [row[counted].strip() if counted is not None and counted < len(row) else "" for row in body]
    # A number for each row counts rows.
    of_run = of_run if _FEWEST * len(set(of_run)) <= len(of_run) else [""] * len(of_run)
    column = direction_column(columns, body)
    told_above = ways_above(above)
    ways: list[Direction | None] = [told_above.pop() if len(told_above) == 1 else None]
    begins = [0]
    for n, row in enumerate(body):
        told = way_of_title(row) if column is None else way_of(row[column].lower()) if column < len(row) else None
        if n and of_run[n] and of_run[n] != of_run[n - 1]:
            begins.append(n)
            ways.append(told or ways[-1])
        elif told is not None and (column is None or told != ways[-1]):
            if n:
                begins.append(n)
            else:
                ways.clear()
            ways.append(told)
    alternate = len(begins) > min(len(body) / _FEWEST, _MOST_PARTS)
    parts: dict[object, tuple[Direction | None, NDArray[np.bool_]]] = {}
    for way, a, b in zip(ways, begins, [*begins[1:], len(body)], strict=True):
        key = (way, of_run[a]) if alternate and body else a
        parts.setdefault(key, (way, np.zeros(len(body), dtype=np.bool_)))[1][a:b] = True
    return list(parts.values())


def ways_above(above: Sequence[Sequence[str]]) -> set[Direction]:
    """Return the directions that titles above a table name."""
    return {way for row in above if (way := way_of_title(row)) is not None}


def require_one_way(above: Sequence[Sequence[str]], path: Path) -> None:
    """Refuse titles that name both directions above readings of one: of which they are, nobody knows."""
    if len(ways_above(above)) > 1:
        raise InputError(
            "the titles name both directions, and nothing says of which the readings are",
            code="circle_table.direction",
            where=str(path),
            got="; ".join(" ".join(row).strip() for row in above if way_of_title(row))[:120],
            allowed="one direction above, or ccw [µm], cw [µm] as heads",
            hint="--direction CCW or CW",
        )


def run_column(columns: Sequence[Column]) -> int | None:
    """Return the column that counts runs; None without."""
    return next((i for i, column in enumerate(columns) if _RUN.fullmatch(bare(column))), None)


def direction_column(columns: Sequence[Column], body: Sequence[Sequence[str]]) -> int | None:
    """Return the column that tells of each row its direction, by its head, or by its cells: words that all name one; None without."""
    named = next((i for i, c in enumerate(columns) if not c.unit and _DIRECTION.fullmatch(bare(c))), None)
    if named is not None:
        return named
    for i, column in enumerate(columns):
        cells = (cell for row in body if i < len(row) and (cell := row[i].strip().lower()))
        # The first cell tells of most columns that they are none.
        if not column.unit and (first := next(cells, "")) and all(map(_tells_way, chain((first,), cells))):
            return i
    return None


def _tells_way(cell: str) -> bool:
    return way_of(cell) is not None and not _SIDES.search(cell)


def require_ways(columns: Sequence[Column], body: Sequence[Sequence[str]], path: Path) -> None:
    """Refuse a column of directions that names none: a circle each way round would be one of two turns."""
    if (i := direction_column(columns, body)) is not None:
        cells = {row[i].strip() for row in body if i < len(row)} - {""}
        if strange := sorted(cell for cell in cells if way_of(cell.lower()) is None):
            raise InputError(
                "a column of directions does not say which way round",
                code="circle_table.direction",
                where=f"{path} {columns[i].head}",
                got=", ".join(strange)[:80],
                allowed="CCW, CW, G3, G2",
                hint="replace the words, or take the column out: then the direction is the one in which the angle runs",
            )


def way_of_title(row: Sequence[str]) -> Direction | None:
    """Return the direction that a title names, of a single cell or behind a word such as ``Direction``.

    CW42 is a week, and what is on the right no direction.
    """
    told = [cell.strip().lower() for cell in row if cell.strip()]
    said = [part.strip(" :=") for cell in told for part in re.split(r"[:=;,](?!\d)", cell) if part.strip(" :=")]
    behind = [way for word, part in pairwise(said) if _DIRECTION.fullmatch(word) and (way := way_of(part))]
    if behind or len(told) > 2:
        return behind[0] if len(set(behind)) == 1 else None
    if len(told) == 2:
        code = re.search(r"\bg0?[23]\b|^(c?cw|acw)$", told[1])
        return way_of(re.sub(r"\W+", " ", told[1])) if code else None
    words = re.sub(r"(?<!lauf )\b(left|right|links|rechts)\b|\bcw\d\d", "", told[0]) if told else ""
    return way_of(re.sub(r"[^\w-]+", " ", words))


@lru_cache(1024)
def way_of(name: str) -> Direction | None:
    """Return the direction that a head in small letters names; None where it names none, or both."""
    name = in_english(name)
    for spelt, short in _SPELT:
        name = spelt.sub(f" {short} ", name)
    words = [re.sub(r"\d+$", "", word) if not re.fullmatch(r"g0?[23]", word) else word for word in name.split()]
    told = {_WAYS[word] for word in words if word in _WAYS}
    way = told.pop() if len(told) == 1 else None
    return "CCW" if way == "CCW" else "CW" if way == "CW" else None


def beside_way(name: str) -> tuple[str, list[int]]:
    """Return what a head in small letters says beside its direction, and its numbers."""
    for spelt, short in _SPELT:
        name = spelt.sub(f" {short} ", name)
    words = [word for word in re.findall(r"[^\W_]+", name) if not re.fullmatch(r"g0?[23]", word)]
    rest = [re.sub(r"\d", "", word) for word in words]
    return " ".join(word for word in rest if word and word not in _WAYS), [
        int(n) for n in re.findall(r"\d+", " ".join(words))
    ]


def may_be_gon(column: Column, angle_deg: Floats) -> bool:
    """Tell whether angles whose head says ``Grad``, which is a degree or 1/400 of a turn, run over 400 of it, as a whole turn in gon does."""
    there = angle_deg[np.isfinite(angle_deg)]
    if not re.search(r"\bgrad\b", column.head + " " + column.unit, re.I) or there.size < 2:
        return False
    span = float(np.ptp(there))
    return 400.0 - 1.5 * float(np.median(np.abs(np.diff(there)))) <= span <= 400.0 * (1.0 + 1e-6)


def stretches(angle: Floats) -> list[slice]:
    """Return stretches between turning points, none of no angle; shaking by less than ``_BACK_DEG`` is none."""
    if not angle.size:
        return []
    begins, end, sign = [0], 0, 0.0
    # Readings at one place, where the machine turns or waits, differ by their last digits.
    least = 0.1 * float(np.median(np.abs(np.diff(angle)))) if angle.size > 1 else 0.0
    for n in range(1, angle.size):
        moved = angle[n] - angle[end]
        if sign == 0.0 and abs(moved) > _BACK_DEG:
            sign = float(np.sign(moved))
        if moved * sign > least:
            end = n
        elif sign and -moved * sign > _BACK_DEG:
            # The reading at the turn was reached on the way there.
            begins.append(end + 1)
            sign, end = -sign, n
    return [slice(a, b) for a, b in zip(begins, [*begins[1:], angle.size], strict=True)]


def in_motion(angle: Floats) -> tuple[slice, list[Finding]]:
    """Return which rows of a stretch are not of a machine that stands before or after its motion, and how many are."""
    steps = np.abs(np.diff(angle))
    usual = float(np.median(steps[steps >= 0.25 * np.quantile(steps, 0.9)])) if steps.size else 0.0
    stands = [int(np.argmin(np.append(np.abs(a - a[0]) < 0.5 * usual, False))) for a in (angle, angle[::-1])]
    before, after = (n - 1 if n >= _STANDS else 0 for n in stands)
    if (not before and not after) or before + after >= angle.size - 2:
        return slice(None), []
    said = f"the machine stands in {before} rows before and {after} after the motion: they are left out"
    return slice(before, angle.size - after), [Finding("circle_table.stands", "info", said)]


def coarse(coordinates_mm: Sequence[Floats]) -> list[Finding]:
    """Return that coordinates are written in steps that hide deviations."""
    um = np.concatenate([1e3 * values[np.isfinite(values)] for values in coordinates_mm] or [np.empty(0)])
    step_um = next(
        (step for step in _COARSE_UM if um.size and np.all(np.abs(um / step - np.round(um / step)) < 1e-6)), 0.0
    )
    if not step_um:
        return []
    said = f"the coordinates are written in steps of {shown_number(step_um)} µm: what is smaller in the figures is of these steps; export more decimals"
    return [Finding("circle_table.coarse", "warning", said, {"step_um": step_um})]
