"""Heads that stand in a text again, rows of more or fewer cells than their table has, and numbers in heads: what would be read as something else."""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from itertools import islice, takewhile
from pathlib import Path

from dtwin.acquire.foreign_columns import is_number
from dtwin.acquire.table_dialect import is_comment, mark_of
from dtwin.errors import InputError

_CELLS = re.compile(r"[;,\t|]")
_MARKS = "#*|=;, \t"
_TIME = re.compile(r"\d{1,2}:\d{2}|\d{4}-\d\d-\d\d|\d{1,2}[./]\d{1,2}[./]\d{2,4}")
_COUNTED = re.compile(
    r"\W*(messreihe|messung|measurement|serie|série|series|session|run|cycle|repeat|trial|pass|turn|zyklus|lauf|test|essai|prova|prueba)(?![a-z])",
    re.I,
)
"""What a title says of which there are several on one machine."""
_NUMERIC = re.compile(r"[+\-\u2212]?[.,]?\d")
_LOOKED_AT = 5000
_LEFT_OUT = 5
"""Numbers of repeats that may be left out, beside as many as there are."""
_END_LOOKED_AT, _FEWEST_ABOVE = 10_000, 8
_DECIMALS = re.compile(r"^[-+]?\d+[.,](\d+)$")


def counts_repeats(numbers: Collection[int], first: int = 1) -> bool:
    """Return whether different numbers of heads, or rows, may count repeats from ``first``: temperatures, years and serial numbers do not."""
    return max(numbers, default=first) - first < 2 * len(numbers) + _LEFT_OUT


def require_heads(heads: Sequence[str], path: Path, allowed: str) -> None:
    """Refuse a table of numbers alone, whose first row stands where heads should; ``allowed``: what they may be."""
    if heads and all(map(is_number, heads)):
        raise InputError(
            "the first line of the table holds numbers, and no heads",
            code="columns.heads",
            where=str(path),
            got=", ".join(heads)[:80],
            allowed=allowed,
            hint="write the heads, with their units, above the first line",
        )


def require_one_block(
    text: str,
    path: Path,
    counted: Callable[[str], object] = lambda title: None,
    needed: Callable[[str], bool] = lambda cell: True,
) -> None:
    """Refuse a text whose heads stand there again below other titles, in comments as well: repeats are called runs, or by a number or a time; and what :func:`require_heads_for_all` refuses.

    ``counted``: tells of a title whether it is one of such, too.
    ``needed``: tells of a cell whether it belongs to the heads that are meant: a report has other tables beside.
    """
    require_heads_for_all(text, path)
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


def require_heads_for_all(text: str, path: Path) -> None:
    """Refuse rows of more numbers than there are heads: cells would be read as their neighbours.

    Of ``37,5`` commas make two cells; some programs number their rows, and write no head above the numbers. Rows that lack a number are refused, too.
    """
    require_whole_end(text, path)
    _require_cells_for_all(text, path)
    # A log of hours is as wide as its begin.
    lines = list(islice((line for line in text.splitlines() if line.strip() and not is_comment(line)), _LOOKED_AT))
    mark = mark_of(lines)
    if mark == " ":
        return
    try:
        rows = list(csv.reader(lines, delimiter=mark))
    except csv.Error:
        return
    begin = next((n for n, row in enumerate(rows) if len(row) > 1 and _is_of_numbers(row, mark)), 0)
    heads = max(map(len, rows[:begin]), default=0)
    body = [row for row in rows[begin:] if _is_of_numbers(row, mark)]
    more = [row for row in body if len(row) > heads and any(_is_number(cell, mark) for cell in row[heads:])]
    # One row alone may have a remark behind it, which a comma cannot be told from.
    if heads > 1 and more and (mark == "," or len(more) > len(body) / 2):
        raise InputError(
            "rows have more numbers than there are heads",
            code="table.more_cells",
            where=str(path),
            got=f"{len(more[0])} cells below {heads} heads: {', '.join(more[0])[:60]}",
            allowed="a head for each column; where commas part the columns, decimal points, or numbers in quotes",
            hint="save the table anew with points, or with semicolons; write a head above numbers of rows, such as No.",
        )


def require_whole_end(text: str, path: Path) -> None:
    """Refuse a table that ends in the middle of a number: with fewer decimals than all before it have, and no end of the line.

    ``text``: the whole table, or its end.
    """
    *lines, last = text[-_END_LOOKED_AT:].split("\n")
    if not last.strip() or last.endswith("\r"):
        return
    parted = r"[;\t]" if re.search(r"[;\t]", last) else r"[,\s]"
    above, cut = ([re.split(parted, line.strip(' "\r')) for line in part] for part in (lines[::-1], [last]))
    tails = [tail[1] for tail in takewhile(bool, (_DECIMALS.match(row[-1]) for row in above)) if tail]
    told = {len(tail) for tail in tails}
    # Programs that write 21.0 as 21 end no number in 0.
    fixed = len(tails) >= _FEWEST_ABOVE and len(told) == 1 and any(tail.endswith("0") for tail in tails)
    end = cut[0][-1].replace(",", ".")
    if fixed and len(cut[0]) == len(above[0]) and is_number(end) and len(end.partition(".")[2]) < min(told):
        raise InputError(
            "the table ends in the middle of a number, as it seems: it was cut short",
            code="table.cut",
            where=f"{path}, last line",
            got=f"{last.strip()[-60:]}, below numbers of {min(told)} decimals",
            allowed="a whole last line",
            hint="copy or export the file again; or take its last line out",
        )


def _require_cells_for_all(text: str, path: Path) -> None:
    """Refuse a row that ends before columns in which most of its table has numbers: which of its cells is missing is not told."""
    told = [(n, line) for n, line in enumerate(text.splitlines(), start=1) if line.strip() and not is_comment(line)]
    mark = mark_of([line for _, line in told])
    mark = mark if any(mark in line for _, line in told) else " "
    first = [line.lstrip(' "').partition(mark)[0] for _, line in told]
    often = Counter(first)
    rows: list[tuple[int, str]] = []
    for one, begin in zip([*told, (0, "")], [*first, ""], strict=True):
        # Below other heads, or a title, another table begins.
        if begin and (_NUMERIC.match(begin) or often[begin] > 1):
            rows.append(one)
            continue
        if len({line.count(mark) for _, line in rows}) > 1:
            _require_alike(rows, mark, path)
        rows = []


def _require_alike(lines: list[tuple[int, str]], mark: str, path: Path) -> None:
    try:
        parsed = (line.split() if mark == " " else next(csv.reader([line], delimiter=mark)) for _, line in lines)
        cells = [[cell.strip() for cell in row] for row in parsed]
    except csv.Error:
        return
    width, often = Counter(map(len, cells)).most_common(1)[0]
    whole = [row for row in cells if len(row) == width]
    known = {row[0] for row in whole}
    for (n, line), row in zip(lines, cells, strict=True):
        of_table = 1 < len(row) < width and (_NUMERIC.match(row[0]) or row[0] in known)
        if not of_table or 2 * often <= len(cells) or not any(_is_number(cell, mark) for cell in row):
            continue
        filled = sum(all(_is_number(cell, mark) for cell in full[len(row) :]) for full in whole)
        if 2 * filled > len(whole):
            raise InputError(
                "a row lacks cells: its numbers may stand below the heads of their neighbours",
                code="table.fewer_cells",
                where=f"{path} row {n}",
                got=f"{len(row)} cells of {width}: {line.strip()[:60]}",
                allowed="a cell for each column, empty where nothing was read",
                hint="write the marks between empty cells; where the file was cut short, take its last row out",
            )


def _is_of_numbers(row: list[str], mark: str) -> bool:
    words = (cell for cell in row if any(map(str.isalpha, cell)))
    return _is_number(row[0], mark) and all(_is_number(cell, mark) for cell in words)


def _is_number(cell: str, mark: str) -> bool:
    return is_number(cell if mark == "," else cell.replace(",", "."))


def _cells(line: str) -> list[str]:
    return [cell for cell in map(str.strip, _CELLS.split(line.strip(_MARKS))) if cell]


def _is_head(line: str) -> bool:
    cells = _cells(line)
    return len(cells) > 1 and all(any(map(str.isalpha, cell)) and not is_number(cell) for cell in cells)


def _is_row(line: str) -> bool:
    first, *others = _cells(line)
    return bool(others) and is_number(first)
