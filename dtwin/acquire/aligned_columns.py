"""Tables of text whose columns are parted by blanks or tabs, as many as a line needs to stand below its head."""

from __future__ import annotations

import re
from collections.abc import Sequence

_NUMBER = re.compile(r"[+\-\u2212]?(\d[\d.,]*(?<![.,])|\.\d+)(e[+-]?\d+)?", re.I)
_GAP = re.compile(r"\s*\t\s*|\s{2,}")
# A unit belongs to the head in front of it.
_BLANK = re.compile(r"\s+(?![\[(])")
_RULE = re.compile(r"[-=_+\s]+")
_GROUPS = re.compile(r"\d \d{3}(?!\d)")
_OTHER_MARKS = re.compile(r"[;|=]")
_FIRST = 100


def aligned_rows(lines: Sequence[str], mark: str) -> list[list[str]]:
    """Return the rows of a table that blanks part, titles as rows of one cell; empty where another mark parts it, or where it is in doubt.

    ``mark``: what parts the columns otherwise. Every row of numbers, and the heads above, have as many cells; two words with one blank between
    them are one head, unless all heads and numbers are parted so.
    """
    if len(lines) > _FIRST and not aligned_rows(lines[:_FIRST], mark):
        return []
    lines = [line.strip() for line in lines if not _RULE.fullmatch(line)]
    numbers = [n for n, line in enumerate(lines) if _holds_numbers(line)]
    leading = [n for n in numbers if _NUMBER.fullmatch(lines[n].split()[0])]
    # Below a number stand numbers: a head may be Target 1 2 3, and a last row Mean 1.2 1.3.
    body = set(leading if len(leading) > 1 else numbers)
    begin = min(body, default=0)
    if len(body) < 2 or begin == 0 or any(_OTHER_MARKS.search(lines[n]) for n in body):
        return []
    told = [lines[n] for n in (begin - 1, *sorted(body))]
    if min(line.count(mark) for line in told) == max(line.count(mark) for line in told) > 0:
        return []
    for part in (_GAP, _BLANK):
        widths = {len(part.split(line)) for line in told[1:]}
        # A lone blank may stand within the digits of a number.
        doubt = part is _BLANK and any(map(_GROUPS.search, told[1:])) and any(map(_GAP.search, told[1:]))
        heads = next((h for p in (_GAP, _BLANK) if len(h := p.split(told[0])) in widths), [])
        if len(widths) == 1 and heads and len(heads) > 1 and not doubt:
            rows = [part.split(line) if n in body else _GAP.split(line) for n, line in enumerate(lines)]
            rows[begin - 1] = heads
            return [row if len(row) == len(heads) else [line] for row, line in zip(rows, lines, strict=True)]
    return []


def _holds_numbers(line: str) -> bool:
    cells = line.split()
    numbers = [_NUMBER.fullmatch(cell) is not None for cell in cells]
    return sum(numbers) > 1 and 2 * sum(numbers) >= len(cells) and (numbers[0] or numbers[-1])
