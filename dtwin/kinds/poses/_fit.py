"""Terms fitted to measured poses, with what cannot be told, and their worth on poses left out."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dtrtrs

from dtwin.kinds.poses._effects import EFFECTS, Term
from dtwin.kinds.poses._series import Series
from dtwin.schema import Floats

# A parameter is told when more than this of its column is not in those of the others.
_LEAST_OWN = 0.03
_SETUP = 9
_NOTHING = 1e-10


@dataclass(frozen=True)
class Grams:
    """Normal equations of every block.

    ``normal``, ``right``, ``power`` (blocks, m, m) or (blocks, m) or (blocks,): of the scaled columns, and the squares
    of the errors.
    """

    series: Series
    scale: Floats = field(init=False)
    normal: Floats = field(init=False)
    right: Floats = field(init=False)
    power: Floats = field(init=False)

    def __post_init__(self) -> None:
        series, m = self.series, self.series.design.shape[2]
        scale = np.sqrt((series.design**2).sum(axis=(0, 1)))
        scale[scale <= 0.0] = 1.0
        normal, right, power = [], [], []
        for block in range(int(series.block.max()) + 1):
            rows = series.block == block
            x, y = series.design[rows].reshape(-1, m) / scale, series.error_mm[rows].ravel()
            normal.append(x.T @ x)
            right.append(x.T @ y)
            power.append(y @ y)
        for name, value in (("scale", scale), ("normal", normal), ("right", right), ("power", power)):
            object.__setattr__(self, name, np.array(value))

    @cached_property
    def count(self) -> Floats:
        """Poses in each block."""
        return np.bincount(self.series.block).astype(np.float64)

    @cached_property
    def whole(self) -> Floats:
        """Normal equations of all blocks, (m, m)."""
        return np.asarray(self.normal.sum(axis=0))

    def without(self, blocks: Floats) -> Grams:
        """Return the same problem without some blocks."""
        kept = np.setdiff1d(np.arange(len(self.power)), blocks)
        part = copy(self)
        for name in ("normal", "right", "power"):
            object.__setattr__(part, name, getattr(self, name)[kept])
        part.__dict__["count"] = self.count[kept]
        part.__dict__.pop("whole", None)
        return part

    def left_elsewhere_mm(self, chosen: Sequence[int], rows: NDArray[np.bool_]) -> Floats:
        """Return what parameters fitted to these blocks leave of other rows of the series, shape (n, 3)."""
        told = self.told(chosen)
        value, _ = solve(self, told)
        return np.asarray(self.series.error_mm[rows] - self.series.design[rows][:, :, told] @ value)

    def told(self, chosen: Sequence[int]) -> list[int]:
        """Return those parameters that the poses can tell, the set-up's first and in the order given."""
        kept: list[int] = []
        whole, basis = self.whole, list[int]()
        # Rows of the Cholesky factor of those that are kept.
        factor = np.zeros((len(chosen), len(chosen)))
        for i in chosen:
            n = len(basis)
            # As solve_triangular, which looks at its arguments for longer than it takes.
            across = dtrtrs(factor[:n, :n].T, whole[basis, i], lower=0, trans=1)[0] if n else np.zeros(0)
            own = float(whole[i, i] - across @ across)
            if i >= _SETUP and own <= _LEAST_OWN**2:
                continue
            kept.append(i)
            if own > _NOTHING:
                factor[n, :n], factor[n, n] = across, np.sqrt(own)
                basis.append(i)
        return kept

    def left_out(self, chosen: Sequence[int]) -> Floats:
        """Return the sum of squares that is left in each block when it was held out, mm²."""
        inner = self._inner(chosen)
        value = self._without_each(chosen, inner)
        own = np.einsum("bi,bij,bj->b", value, inner, value)
        return np.asarray(self.power - 2.0 * np.einsum("bi,bi->b", value, self.right[:, chosen]) + own)

    def without_each(self, chosen: Sequence[int]) -> Floats:
        """Return the scaled parameters fitted without each block, shape (blocks, parameters)."""
        return self._without_each(chosen, self._inner(chosen))

    def _inner(self, chosen: Sequence[int]) -> Floats:
        at = np.array(chosen, dtype=np.intp)
        return np.asarray(self.normal[:, at[:, None], at])

    def _without_each(self, chosen: Sequence[int], inner: Floats) -> Floats:
        rest = inner.sum(axis=0) - inner
        # Setup terms may be collinear: their values do not matter, their sum does.
        rest += _NOTHING * np.trace(rest, axis1=1, axis2=2)[:, None, None] / len(chosen) * np.eye(len(chosen))
        right = self.right[:, chosen]
        to = right.sum(axis=0) - right
        return np.asarray(np.linalg.solve(rest, to[:, :, None])[:, :, 0])


@dataclass(frozen=True)
class Parameter:
    """A fitted parameter; ``value`` and its half width ``k2``, which covers 95 %, are NaN when the poses cannot tell it."""

    term: Term
    name: str
    unit: str
    value: float
    k2: float


def solve(grams: Grams, chosen: Sequence[int]) -> tuple[Floats, Floats]:
    """Return the values of the parameters chosen, and their covariance with whole blocks as units.

    The sandwich over blocks: neighbouring poses err alike, whatever is missing.
    """
    index = np.ix_(chosen, chosen)
    inverse = np.linalg.pinv(grams.whole[index], rcond=1e-12, hermitian=True)
    value = inverse @ grams.right.sum(axis=0)[chosen]
    scores = np.array(
        [to[chosen] - normal[index] @ value for normal, to in zip(grams.normal, grams.right, strict=True)]
    )
    blocks, numbers = len(scores), 3.0 * float(grams.count.sum())
    # Few blocks, and few readings for the parameters, leave too little: as is usual for clusters.
    few = blocks / max(blocks - 1, 1) * (numbers - 1.0) / max(numbers - len(chosen), 1.0)
    spread = inverse @ (scores.T @ scores) @ inverse * few
    scale = grams.scale[list(chosen)]
    return value / scale, spread / np.outer(scale, scale)


def with_correlations(grams: Grams, chosen: Sequence[int], covariance: Floats) -> Floats:
    """Return a covariance whose correlations are those of the normal equations: a few blocks tell variances, and no correlations."""
    inverse = np.linalg.pinv(grams.whole[np.ix_(chosen, chosen)], rcond=1e-12, hermitian=True)
    spread = np.sqrt(np.diag(covariance) / np.maximum(np.diag(inverse), 1e-300))
    return np.asarray(inverse * np.outer(spread, spread))


def dof_of(grams: Grams) -> float:
    """Return the degrees of freedom of what blocks scatter by."""
    return max(len(grams.power) - 1.0, 1.0)


def parameters_with(grams: Grams, terms: Sequence[Term], value: Floats, half: Floats) -> list[Parameter]:
    """Return every parameter of some terms; ``value``, ``half``: of those that the poses tell, with the half width."""
    at = {i: n for n, i in enumerate(grams.told(grams.series.chosen(terms)))}
    out = []
    for term, offset, i in slots_of(grams, terms):
        name, unit = EFFECTS[term.effect].parameters[offset]
        n = at.get(i)
        own, wide = (float("nan"), float("nan")) if n is None else (float(value[n]), float(half[n]))
        out.append(Parameter(term, name, unit, own, wide))
    return out


def slots_of(grams: Grams, terms: Sequence[Term]) -> list[tuple[Term, int, int]]:
    """Return term, number within it, and number in the design, of every parameter."""
    slots = grams.series.slots
    return [(term, i - slots[term].start, i) for term in terms for i in range(slots[term].start, slots[term].stop)]


def left_mm(grams: Grams, terms: Sequence[Term]) -> Floats:
    """Return what the terms leave of the errors, shape (n, 3)."""
    value, _ = solve(grams, grams.told(grams.series.chosen(terms)))
    return left_with_mm(grams, terms, value)


def left_with_mm(grams: Grams, terms: Sequence[Term], value: Floats) -> Floats:
    """Return what values of the parameters that the poses tell leave of the errors, shape (n, 3)."""
    series = grams.series
    return np.asarray(series.error_mm - series.design[:, :, grams.told(series.chosen(terms))] @ value)


def held_out_mm(grams: Grams, terms: Sequence[Term]) -> Floats:
    """Return what the terms leave in blocks that were held out of the fit, shape (n, 3)."""
    series = grams.series
    told = grams.told(series.chosen(terms))
    left = np.empty_like(series.error_mm)
    for block, value in enumerate(grams.without_each(told)):
        rows = series.block == block
        left[rows] = series.error_mm[rows] - series.design[rows][:, :, told] @ (value / grams.scale[told])
    return left
