"""Least squares of many rows in little memory: QR, block by block."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from dtwin.errors import InputError
from dtwin.schema import Floats

BLOCK_ROWS = 8192
_RANK = 1e-12


@dataclass(frozen=True)
class Solution:
    """Least-squares solution.

    Attributes
    ----------
    x : ndarray, shape (k,)
        Smallest solution when the columns are dependent.
    rank : int
        Number of independent columns.
    condition : float
        Ratio of the largest singular value of the scaled columns to the smallest one kept.
    residual_rms : float
        RMS of what is left.
    triangle : ndarray, shape (k, k)
        R of the QR decomposition: R^T R is the normal matrix, never formed.
    null_space : ndarray, shape (k, k - rank)
        Combinations of the scaled columns that vanish.
    """

    x: Floats
    rank: int
    condition: float
    residual_rms: float
    triangle: Floats
    null_space: Floats


def solve_blocks(blocks: Iterable[tuple[Floats, Floats]]) -> Solution:
    """Solve a least-squares problem that comes in blocks of rows.

    Parameters
    ----------
    blocks : iterable of (ndarray of shape (n, k), ndarray of shape (n,))
        Columns and right sides.

    Raises
    ------
    InputError
        When there is no row.

    Notes
    -----
    Each block is reduced by Householder QR together with the triangle of the blocks before
    (Golub and Van Loan, 5.2): as accurate as QR of the whole, while only one block is in memory.
    """
    triangle: Floats | None = None
    n = 0
    for columns, right in blocks:
        n += len(columns)
        block = np.column_stack([columns, right])
        triangle = _triangle(block if triangle is None else np.vstack([triangle, block]))
    if triangle is None or n == 0:
        raise InputError("there is nothing to fit", code="fit.empty")
    k = triangle.shape[1] - 1
    if len(triangle) < k + 1:
        triangle = np.vstack([triangle, np.zeros((k + 1 - len(triangle), k + 1))])
    return _solved(triangle[:k, :k], triangle[:k, k], float(triangle[k, k]), n)


def in_blocks(columns: Floats, right: Floats) -> Iterable[tuple[Floats, Floats]]:
    """Cut columns (n, k) and right side (n,) into blocks of rows."""
    for start in range(0, len(right), BLOCK_ROWS):
        yield columns[start : start + BLOCK_ROWS], right[start : start + BLOCK_ROWS]


def _triangle(stacked: Floats) -> Floats:
    if not np.isfinite(stacked).all():
        raise InputError("the columns of a fit are not finite", code="fit.not_finite")
    return np.asarray(np.linalg.qr(stacked, mode="r"))


def _solved(triangle: Floats, right: Floats, left: float, n: int) -> Solution:
    size = np.sqrt((triangle**2).sum(axis=0))
    scale = np.where(size > 0.0, size, 1.0)
    u, values, vt = np.linalg.svd(triangle / scale)
    keep = values > _RANK * max(float(values[0]) if len(values) else 0.0, 1e-300)
    rank = int(keep.sum())
    x = vt[keep].T @ ((u.T @ right)[keep] / values[keep]) / scale
    lost = float(((u.T @ right)[~keep] ** 2).sum())
    return Solution(
        x=x,
        rank=rank,
        condition=float(values[0] / values[keep][-1]) if rank else float("inf"),
        residual_rms=float(np.sqrt((left**2 + lost) / n)),
        triangle=triangle,
        null_space=vt[~keep].T,
    )
