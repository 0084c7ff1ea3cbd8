"""Directions of approach that a table does not name, from the order in which its targets were read."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dtwin.errors import InputError
from dtwin.schema import Floats

_FEWEST = 2
"""Readings of a sweep."""
_SENSE = re.compile(r"(?<![^\W_])c?cw(?![^\W\d_])|(counter|anti)?-?clockwise|(im|gegen(\s+den)?)\s+uhrzeigersinn", re.I)


def ways_in_order(target_mm: Sequence[float]) -> list[str] | None:
    """Return the direction of each reading; None where the order does not tell it.

    Targets that begin anew after the last one were all approached from one side: the way back was not read.
    """
    if len(set(target_mm)) < _FEWEST:
        return None
    pieces = sweeps(np.array(target_mm, dtype=float))
    long = {sign for piece, sign in pieces if piece.stop - piece.start >= _FEWEST}
    begun_anew = [sign for piece, sign in pieces if piece.stop - piece.start < _FEWEST]
    if len(long) == 1 and len(set(target_mm)) > _FEWEST and set(begun_anew) <= {-sign for sign in long}:
        # Each single reading is the first of the sweep after it.
        one = "forward" if long == {1} else "reverse"
        last = pieces[-1][0]
        return None if begun_anew and last.stop - last.start < _FEWEST else [one] * len(target_mm)
    if begun_anew:
        return None
    return ["forward" if sign > 0 else "reverse" for piece, sign in pieces for _ in range(piece.start, piece.stop)]


def names_sense(cell: str) -> bool:
    """Return whether a head or a cell names a sense of turning, which is no direction: CW, CCW."""
    return _SENSE.search(cell) is not None


def no_direction(path: Path, got: str, allowed: str) -> InputError:
    """Return the refusal of a table whose directions nothing tells."""
    sense = "; which of CW and CCW is positive depends on from where one looks, and nothing tells that"
    return InputError(
        "the table does not say from which side its targets were approached" + sense * names_sense(got),
        code="position_table.direction",
        where=str(path),
        got=got[:80],
        allowed=allowed,
        hint="docs/how-to/positioning-table.md",
    )


def sweeps(position: Floats) -> list[tuple[slice, int]]:
    """Part successive targets into sweeps of one direction.

    At a turn the same target is read twice, from one side and from the other; where one of the
    two is missing, the other belongs to the sweep before.

    ``position``, (n,): targets in the order of measurement.
    Rows of each sweep, and +1 or -1 for its direction.
    """
    pieces: list[tuple[slice, int]] = []
    begun, sign = 0, 0
    for i, step in enumerate(np.sign(np.diff(position)).astype(int).tolist()):
        if step == 0 or (sign and step != sign):
            pieces.append((slice(begun, i + 1), sign or _other(pieces)))
            begun, sign = i + 1, step
        else:
            sign = step
    pieces.append((slice(begun, len(position)), sign or _other(pieces)))
    return pieces


def _other(pieces: list[tuple[slice, int]]) -> int:
    return -pieces[-1][1] if pieces else 1
