"""Linear models of a log with each block of it held out, and with a column more or less: what they share is worked out once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dtwin.schema import Floats

_EPS = float(np.finfo(float).eps)


@dataclass(frozen=True)
class _Others:
    """Least squares on all blocks but one.

    ``triangles`` (m, columns + 1): rows with the squares of the columns and, last, of the readings.
    ``along`` (m, k), ``scale`` (k,), ``turned`` (k, columns): their singular values and vectors; what is no more than rounding
    is left out.
    """

    triangles: Floats
    along: Floats
    scale: Floats
    turned: Floats

    def values(self, readings: Floats) -> Floats:
        """Return the least values of the columns for readings (m, several)."""
        return np.asarray(self.turned.T @ ((self.along.T @ readings) / self.scale[:, None]))


class HeldOut:
    """A linear model, fitted without each block.

    ``x`` (n, columns), ``y`` (n,), ``block`` (n,): numbers of the blocks, from 0 on.
    """

    def __init__(self, x: Floats, y: Floats, block: Floats) -> None:
        whole = np.column_stack([x, y])
        self._rows = [block == number for number in range(int(block.max()) + 1)]
        # Triangles of the blocks give the squares of all readings.
        split = [np.linalg.qr(whole[rows]) for rows in self._rows]
        self._turns, self._parts = [q for q, _ in split], [r for _, r in split]

    @cached_property
    def _others(self) -> list[_Others]:
        made = []
        for triangles in _all_but_one(self._parts):
            along, scale, turned = np.linalg.svd(triangles[:, :-1], full_matrices=False)
            kept = scale > scale[0] * _EPS * max(triangles.shape)
            made.append(_Others(triangles, along[:, kept], scale[kept], turned[kept]))
        return made

    @cached_property
    def values(self) -> Floats:
        """Values of the columns fitted without each block, (blocks, columns)."""
        return np.array([others.values(others.triangles[:, -1:])[:, 0] for others in self._others])

    @cached_property
    def squares(self) -> Floats:
        """What these leave in the block that was held out, squared, (blocks,)."""
        left = [part[:, -1] - part[:, :-1] @ value for part, value in zip(self._parts, self.values, strict=True)]
        return np.array([float((one**2).sum()) for one in left])

    def with_each(self, columns: Floats) -> Floats:
        """Return the squares with each of further columns (n, several) beside the model, (several, blocks)."""
        along = [turn.T @ columns[rows] for turn, rows in zip(self._turns, self._rows, strict=True)]
        # Of a column, what lies along no column of the model within its block.
        beside = [
            ((columns[rows] - turn @ part) ** 2).sum(axis=0)
            for turn, rows, part in zip(self._turns, self._rows, along, strict=True)
        ]
        squares = np.empty((columns.shape[1], len(self._parts)))
        for block, (others, new) in enumerate(zip(self._others, _all_but_one(along), strict=True)):
            readings, far = others.triangles[:, -1:], np.sum(beside, axis=0) - beside[block]
            off = new - others.along @ (others.along.T @ new)
            norm = (off**2).sum(axis=0) + far
            free = norm > _EPS * ((new**2).sum(axis=0) + far)
            value = np.where(free, (off * readings).sum(axis=0) / np.where(free, norm, 1.0), 0.0)
            part = self._parts[block]
            left = part[:, -1:] - along[block] * value - part[:, :-1] @ others.values(readings - new * value)
            squares[:, block] = (left**2).sum(axis=0) + beside[block] * value**2
        return squares

    def without_each(self, columns: range) -> Floats:
        """Return the squares without each of some columns of the model, (columns, blocks)."""
        squares = np.empty((len(columns), len(self._parts)))
        at = np.array(columns, dtype=np.int64)
        for block, (others, part, value) in enumerate(zip(self._others, self._parts, self.values, strict=True)):
            inverse = others.turned.T @ (others.turned / others.scale[:, None] ** 2)
            if len(others.scale) == part.shape[1] - 1:
                each = value[:, None] - inverse[:, at] * (value[at] / inverse[at, at])
            else:
                # Columns that are sums of others have values that are not their own.
                each = np.zeros((value.size, at.size))
                for n, column in enumerate(at):
                    kept = np.delete(others.triangles, column, axis=1)
                    each[np.arange(value.size) != column, n] = np.linalg.lstsq(kept[:, :-1], kept[:, -1])[0]
            squares[:, block] = ((part[:, -1:] - part[:, :-1] @ each) ** 2).sum(axis=0)
        return squares


def _all_but_one(parts: Sequence[Floats]) -> Iterator[Floats]:
    for block in range(len(parts)):
        yield np.concatenate([*parts[:block], *parts[block + 1 :]])
