"""Whether the rows of a table are of one circle: columns beside the readings may say that they are of several planes, feeds or states."""

from __future__ import annotations

import re
from collections.abc import Container, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtwin.acquire.foreign_columns import Column
from dtwin.acquire.table_dialect import is_comment
from dtwin.errors import InputError
from dtwin.kinds.circular._circle_ways import run_column
from dtwin.schema import Floats

_FEWEST = 18
"""Rows of a block."""
_LEAST_DEG = 90.0
_BIN_DEG = 10.0
_CONDITION = re.compile(r"plane|ebene|piano|plano|radius|rayon|raggio|radio|diam|durchm|feed|vorschub|avan[cz]", re.I)
"""Head of what one circle has one of."""
_TURNS = re.compile(r"turn|lap|rev(olution)?|umdrehung|umlauf|tour|giro|vuelta", re.I)
_READ = ("_c", "_kpa", "_pct", "_s", "_g", "_v", "_a")
"""How the name of what a sensor reads beside ends."""


@dataclass(frozen=True)
class _Block:
    """Rows that follow each other with one word or number: ``way``, what is told of their direction; ``places``, where they lie on the circle."""

    said: str
    way: Any
    places: frozenset[int]


def require_one_circle(
    columns: Sequence[Column],
    body: Sequence[Sequence[str]],
    angle_deg: Floats,
    ways: Sequence[Any],
    used: Container[int],
    path: Path,
) -> None:
    """Refuse rows that go over the same places again under another plane, feed or state: they would be taken for a second turn, or for repeats.

    ``ways``: of each row, what is told of its direction; None: as the angle runs.
    ``used``: columns that are read.
    """
    for i, column in enumerate(columns):
        if (
            i in used
            or i == run_column(columns)
            or column.name.endswith(_READ)
            or _TURNS.fullmatch(column.head.strip())
        ):
            continue
        cells = [row[i].strip() if i < len(row) else "" for row in body]
        names = set(cells) - {""}
        if len(names) < 2 or _FEWEST * len(names) > len(body) or any(":" in name for name in names):
            continue
        blocks = _blocks(cells, angle_deg, ways)
        one_way = _CONDITION.search(column.head) is None
        for n, block in enumerate(blocks):
            for other in blocks[:n]:
                again = len(block.places & other.places) * _BIN_DEG >= _LEAST_DEG
                if block.said != other.said and again and not (one_way and block.way != other.way):
                    raise InputError(
                        "the rows are of several circles, planes, feeds or states",
                        code="table.several",
                        where=f"{path} {column.head.strip()}",
                        got=", ".join(sorted(names))[:80],
                        allowed="one; or a column direction with CCW and CW, a column run with numbers of repeats",
                        hint="a file for each",
                    )


def require_none_apart(text: str, angle_deg: Floats, path: Path) -> None:
    """Refuse rows of numbers that stand alone below an empty row: means and sums would be taken for readings at the end of the turn."""
    lines = [line.strip(" \t\r,;|") for line in text.splitlines() if not is_comment(line)]
    blocks = [list(block) for filled, block in groupby(lines, bool) if filled]
    apart = len(blocks[-1])
    if len(blocks) > 1 and apart < _FEWEST <= len(blocks[-2]) and np.isfinite(angle_deg[-apart:]).any():
        raise InputError(
            "rows of numbers stand apart below the table",
            code="circle_table.apart",
            where=str(path),
            got=f"an empty row, and below it {blocks[-1][0][:80]}",
            allowed="readings without an empty row between them",
            hint="leave rows of means and sums out; take the empty row out where readings follow it",
        )


def _blocks(cells: Sequence[str], angle_deg: Floats, ways: Sequence[Any]) -> list[_Block]:
    good: NDArray[np.intp] = np.flatnonzero(np.isfinite(angle_deg) & np.array([bool(cell) for cell in cells]))
    begins = [k for k, n in enumerate(good) if not k or cells[n] != cells[good[k - 1]] or ways[n] != ways[good[k - 1]]]
    out = []
    for a, b in zip(begins, [*begins[1:], len(good)], strict=True):
        rows = good[a:b]
        theta = angle_deg[rows]
        if len(rows) < _FEWEST or np.ptp(theta) < _LEAST_DEG:
            continue
        way = ways[rows[0]] or bool(np.median(np.diff(theta)) > 0.0)
        out.append(_Block(cells[rows[0]], way, frozenset((theta % 360.0 // _BIN_DEG).astype(int).tolist())))
    return out
