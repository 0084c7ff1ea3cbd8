"""Whether the rows of a table are of one state of one axis: columns beside the readings may say that feeds, setups or compensation differ."""

from __future__ import annotations

import re
from collections.abc import Container, Hashable, Sequence
from pathlib import Path

from dtwin.acquire.foreign_columns import is_number
from dtwin.acquire.repeated_heads import counts_repeats
from dtwin.errors import InputError

_MOST = 1.0 / 3.0
"""Of the rows: names of states."""
_SAME, _FEWEST = 0.8, 3
"""Of the places of a state, by which another one goes over them again; and places of one."""
_NUMBERED = re.compile(
    r"feed|vorschub|speed|geschw|velocity|load|last\b|masse?\b|offset|height|h[öo]he|override|[xyzabcuvw][\s_]*([\[(]|mm|$)",
    re.I,
)
"""Head of numbers that tell a state, not a reading."""


def _are_counted(names: Sequence[str]) -> bool:
    """Return whether names are one word with numbers that count: ``M1``, ``M2``."""
    told = [re.fullmatch(r"(\D*[^\W\d]\D*)(\d+)", name) for name in names]
    matches = [match for match in told if match is not None]
    words, numbers = {match[1] for match in matches}, {int(match[2]) for match in matches}
    return len(matches) == len(names) and len(words) == 1 and counts_repeats(numbers)


def require_one_state(
    heads: Sequence[str],
    body: Sequence[Sequence[str]],
    places: Sequence[Hashable],
    used: Container[int | None],
    path: Path,
) -> None:
    """Refuse rows that go over the same targets again in another state: they would be taken for cycles.

    ``places``: target and direction of each row.
    ``used``: columns that are read.
    """
    for i in (i for i in range(len(heads)) if i not in used):
        cells = [row[i].strip() if i < len(row) else "" for row in body]
        names = list(dict.fromkeys(cell for cell in cells if cell))
        clock = any(":" in name for name in names)
        numbers = all(map(is_number, names)) and not _NUMBERED.match(heads[i].strip())
        if not 1 < len(names) <= _MOST * len(body) or clock or numbers or _are_counted(names):
            continue
        over = {name: {place for place, cell in zip(places, cells, strict=True) if cell == name} for name in names}
        first, *others = [own for own in over.values() if len(own) >= _FEWEST] or [set()]
        if any(len(first & own) >= _SAME * min(len(first), len(own)) for own in others):
            raise InputError(
                "the rows are of several states, setups or instruments: they would be taken for cycles",
                code="table.several",
                where=f"{path} {heads[i].strip()}",
                got=", ".join(names)[:80],
                allowed="one",
                hint="a file for each; where they are cycles of one test, a column cycle with numbers, and this one left out",
            )
