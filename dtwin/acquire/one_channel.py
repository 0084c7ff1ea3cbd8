"""Whether each row of a table is of all that was read: one with a row for each channel is not read as one of them."""

from __future__ import annotations

import re
from collections.abc import Container, Sequence
from itertools import pairwise
from pathlib import Path

from dtwin.acquire.foreign_columns import is_number
from dtwin.errors import InputError

_CHANNEL = re.compile(
    r"axis|achse|axe|asse|eje|channel|kanal|canale?|ch|sensor|probe|taster|f[üu]hler|name|signal|tag|id", re.I
)
_MOST, _OFTEN = 50, 1.0 / 3.0
"""Channels, and of the rows: how often another one follows."""


def require_one_channel(
    heads: Sequence[str], body: Sequence[Sequence[str]], used: Container[int | None], path: Path
) -> None:
    """Refuse rows that are of several axes, channels or sensors in turn, as a column tells: they would be taken for one."""
    for i in (i for i in range(len(heads)) if i not in used):
        told = [row[i].strip() for row in body if i < len(row) and row[i].strip()]
        names = set(told)
        counted = all(map(is_number, names)) and not _CHANNEL.fullmatch(heads[i].strip())
        turns = sum(a != b for a, b in pairwise(told))
        if 1 < len(names) <= _MOST and 2 * len(names) <= len(told) and not counted and turns > _OFTEN * len(told):
            raise InputError(
                "the rows are of several axes, channels or sensors",
                code="table.several",
                where=f"{path} {heads[i].strip()}",
                got=", ".join(sorted(names))[:80],
                allowed="a row for each time, with a column for each of them",
                hint="a file for each, or a column for each beside the time",
            )
