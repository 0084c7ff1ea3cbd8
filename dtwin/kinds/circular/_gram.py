"""Least squares by sums of squares per condition, so that any condition can be left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dtwin.schema import Floats

# Small: it decides only what the measurements leave open.
_CENTRE_PENALTY = 0.02


@dataclass(frozen=True)
class Sums:
    """Sums over the rows of one cell of the grid.

    ``gram``, (p, p): X'X.
    ``moment``, (p,): X'y.
    ``power``: y'y.
    ``penalty``, (p, p): what is minimised besides the residual.
    """

    gram: Floats
    moment: Floats
    power: float
    rows: int
    penalty: Floats

    def __add__(self, other: Sums) -> Sums:
        return Sums(
            self.gram + other.gram,
            self.moment + other.moment,
            self.power + other.power,
            self.rows + other.rows,
            self.penalty + other.penalty,
        )

    def take(self, chosen: Sequence[int]) -> Sums:
        """Return the sums for a subset of the columns."""
        index = np.asarray(chosen, dtype=int)
        square = np.ix_(index, index)
        return Sums(self.gram[square], self.moment[index], self.power, self.rows, self.penalty[square])

    def residual(self, weights: Floats) -> float:
        """Return the sum of squared residuals under given weights."""
        return float(self.power - 2.0 * weights @ self.moment + weights @ self.gram @ weights)


def sums_of(design: Floats, target: Floats, absorbed: Floats | None = None) -> Sums:
    """Return the sums of one cell.

    ``design``, (n, p): terms with centre and radius of the set-up taken out.
    ``target``, (n,): error with the same taken out.
    ``absorbed``, (n, p): what was taken out of the terms. It is held near zero: an equation that moves the centre of
    the circle spends its clamp on what no measurement has asked for.
    """
    penalty = np.zeros((design.shape[1], design.shape[1]))
    if absorbed is not None:
        penalty = _CENTRE_PENALTY * (absorbed.T @ absorbed)
    return Sums(design.T @ design, design.T @ target, float(target @ target), target.size, penalty)


def total(cells: Sequence[Sums]) -> Sums:
    """Return the sums over several cells."""
    result = cells[0]
    for cell in cells[1:]:
        result = result + cell
    return result


def solve(sums: Sums, ridge: float) -> Floats:
    """Return ridge weights; the penalty is relative to each column's own size.

    ``ridge``: penalty as a share of a column's mean square.
    """
    scale = np.sqrt(np.maximum(np.diag(sums.gram), 1e-300))
    scaled = (sums.gram + sums.penalty) / np.outer(scale, scale)
    scaled[np.diag_indices_from(scaled)] += ridge
    return np.asarray(np.linalg.solve(scaled, sums.moment / scale) / scale)


def forward_order(sums: Sums, groups: Sequence[Sequence[int]], ridge: float) -> list[int]:
    """Return groups of columns in the order in which they reduce the residual most.

    ``groups``: columns that enter together, such as cosine and sine.
    ``ridge``: as in :func:`solve`.
    """
    scale = np.sqrt(np.maximum(np.diag(sums.gram), 1e-300))
    gram = sums.gram / np.outer(scale, scale)
    gram[np.diag_indices_from(gram)] += ridge
    moment = sums.moment / scale
    left = list(range(len(groups)))
    order: list[int] = []
    # Orthogonalise in place: after each step gram and moment are those of the residual.
    while left:
        gains = np.zeros(len(left))
        for size in {len(groups[g]) for g in left}:
            places = [i for i, g in enumerate(left) if len(groups[g]) == size]
            index = np.array([groups[left[i]] for i in places])
            block = gram[index[:, :, None], index[:, None, :]] + 1e-12 * np.eye(size)
            taken = np.linalg.solve(block, moment[index][:, :, None])[:, :, 0]
            gains[places] = np.sum(moment[index] * taken, axis=1)
        best = left.pop(int(np.argmax(gains)))
        order.append(best)
        index = np.array(groups[best])
        block = gram[np.ix_(index, index)] + 1e-12 * np.eye(len(index))
        across = gram[:, index]
        moment = moment - across @ np.linalg.solve(block, moment[index])
        gram = gram - across @ np.linalg.solve(block, across.T)
    return order
