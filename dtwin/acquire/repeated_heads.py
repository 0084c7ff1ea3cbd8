"""Heads that stand in a text again, and numbers in heads: what is of several machines would be taken for repeats on one."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Collection
from pathlib import Path

from dtwin.acquire.foreign_columns import is_number
from dtwin.errors import InputError

_CELLS = re.compile(r"[;,\t|]")
_MARKS = "#*|=;, \t"
_TIME = re.compile(r"\d{1,2}:\d{2}|\d{4}-\d\d-\d\d|\d{1,2}[./]\d{1,2}[./]\d{2,4}")
_COUNTED = re.compile(
    r"\W*(messreihe|messung|measurement|serie|série|series|session|run|cycle|repeat|trial|pass|turn|zyklus|lauf|test|essai|prova|prueba)(?![a-z])",
    re.I,
)
"""What a title says of which there are several on one machine."""
_LEFT_OUT = 5
"""Numbers of repeats that may be left out, beside as many as there are."""


def counts_repeats(numbers: Collection[int], first: int = 1) -> bool:
    """Return whether different numbers of heads, or rows, may count repeats from ``first``: temperatures, years and serial numbers do not."""
    return max(numbers, default=first) - first < 2 * len(numbers) + _LEFT_OUT


def require_one_block(
    text: str,
    path: Path,
    counted: Callable[[str], object] = lambda title: None,
    needed: Callable[[str], bool] = lambda cell: True,
) -> None:
    """Refuse a text whose heads stand there again below other titles, in comments as well: repeats are called runs, or by a number or a time.

    ``counted``: tells of a title whether it is one of such, too.
    ``needed``: tells of a cell whether it belongs to the heads that are meant: a report has other tables beside.
    """
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    again = {line for line, often in Counter(lines).items() if often > 1}
    heads = next((line for line in lines if line in again and _is_head(line) and any(map(needed, _cells(line)))), None)
    if heads is None:
        return
    above = [before.strip(_MARKS) for before, line in zip(["", *lines], lines, strict=False) if line == heads]
    # The last row of a table is no title of the next one.
    told = [t for t in dict.fromkeys(above) if t and len(_cells(t)) < len(_cells(heads)) and not _is_row(t)]
    if len(told) > 1 and not all(
        _COUNTED.match(t) or is_number(t) or _TIME.search(t) or counted(t) is not None for t in told
    ):
        raise InputError(
            "the same heads stand there again below other titles: rows of several axes, machines or tools would be taken for repeats on one",
            code="table.titles",
            where=str(path),
            got=", ".join(told)[:80],
            allowed="one table; or titles such as run 1, run 2",
            hint="a file for each; of positions of axes also one table with a column Axis, of which --axis reads one",
        )


def _cells(line: str) -> list[str]:
    return [cell for cell in map(str.strip, _CELLS.split(line.strip(_MARKS))) if cell]


def _is_head(line: str) -> bool:
    cells = _cells(line)
    return len(cells) > 1 and all(any(map(str.isalpha, cell)) and not is_number(cell) for cell in cells)


def _is_row(line: str) -> bool:
    first, *others = _cells(line)
    return bool(others) and is_number(first)
