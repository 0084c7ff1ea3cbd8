"""Least squares of many rows in little memory: QR, block by block."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack, solve_triangular

from dtwin.errors import InputError
from dtwin.schema import Floats

_BLOCK_ROWS = 2048
_BRANCHES = 32
_RANK = 1e-12


@dataclass(frozen=True)
class Solution:
    """Least-squares solution.

    ``x``, (k,): smallest solution when the columns are dependent.
    ``condition``: ratio of the largest singular value of the scaled columns to the smallest one kept.
    ``null_space``, (k, k - rank): combinations of the scaled columns that vanish.
    """

    x: Floats
    rank: int
    condition: float
    null_space: Floats


def solve_blocks(blocks: Iterable[tuple[Floats, Floats]]) -> Solution:
    """Solve a least-squares problem that comes in blocks of rows.

    Args:
        blocks: Columns and right sides. Shape (n, k), ndarray of shape (n,)).

    Raises:
        InputError: When there is no row.

    Note:
        Each block is reduced to a triangle by Householder QR, and triangles in a tree, so that rounding
        grows with the height of the tree and not with the number of blocks (Demmel, Grigori, Hoemmen and
        Langou 2012, tall-skinny QR). Only one block and some triangles are in memory.
    """
    levels: list[list[Floats]] = []
    for columns, right in blocks:
        _add(levels, 0, _triangle([columns], right))
    if not levels:
        raise InputError("there is nothing to fit", code="fit.empty")
    triangle = _triangle([t for level in levels for t in level])
    k = triangle.shape[1] - 1
    return _solved(triangle[:k, :k], triangle[:k, k])


def in_blocks(columns: Floats, right: Floats) -> Iterable[tuple[Floats, Floats]]:
    """Cut columns (n, k) and right side (n,) into blocks of rows."""
    for start in range(0, len(right), _BLOCK_ROWS):
        yield columns[start : start + _BLOCK_ROWS], right[start : start + _BLOCK_ROWS]


def _add(levels: list[list[Floats]], height: int, triangle: Floats) -> None:
    """Put a triangle into the tree; full branches become one triangle of the next level."""
    if height == len(levels):
        levels.append([])
    levels[height].append(triangle)
    if len(levels[height]) == _BRANCHES:
        branch, levels[height] = levels[height], []
        _add(levels, height + 1, _triangle(branch))


def _triangle(parts: Sequence[Floats], right: Floats | None = None) -> Floats:
    """Return R of stacked parts, square, the right side as last column."""
    rows = sum(len(part) for part in parts)
    width = parts[0].shape[1] + (right is not None)
    # In place and by columns, as LAPACK wants it: numpy's own QR copies every block twice.
    stacked = np.zeros((max(rows, width), width), order="F")
    stacked[:rows, : parts[0].shape[1]] = parts[0] if len(parts) == 1 else np.concatenate(parts)
    if right is not None:
        stacked[:rows, -1] = right
    if not np.isfinite(stacked).all():
        raise InputError("the columns of a fit are not finite", code="fit.not_finite")
    factored, *_ = lapack.dgeqrf(stacked, overwrite_a=1)
    return np.asarray(np.triu(factored[:width]))


def _solved(triangle: Floats, right: Floats) -> Solution:
    size = np.sqrt((triangle**2).sum(axis=0))
    scale = np.where(size > 0.0, size, 1.0)
    u, values, vt = np.linalg.svd(triangle / scale)
    keep = values > _RANK * max(float(values[0]) if len(values) else 0.0, 1e-300)
    rank = int(keep.sum())
    if rank == len(triangle):
        x = solve_triangular(triangle, right)
    else:
        # A column of nothing has nothing, and not what rounding leaves of it.
        x = np.where(size > 0.0, vt[keep].T @ ((u.T @ right)[keep] / values[keep]) / scale, 0.0)
    return Solution(
        x=x, rank=rank, condition=float(values[0] / values[keep][-1]) if rank else float("inf"), null_space=vt[~keep].T
    )
