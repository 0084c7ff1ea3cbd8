"""Terms fitted to measured poses, with what cannot be told, and their worth on poses left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from dtwin.kinds.poses.effects import EFFECTS, Term
from dtwin.kinds.poses.series import Series
from dtwin.schema import Floats

# A parameter is told when more than this of its column is not in those of the others.
_LEAST_OWN = 0.03
_SETUP = 9


@dataclass(frozen=True)
class Grams:
    """Normal equations of every block.

    Attributes
    ----------
    normal, right, power : ndarray, shapes (blocks, m, m), (blocks, m) and (blocks,)
        Of the scaled columns, and the squares of the errors.
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

    def told(self, chosen: Sequence[int]) -> list[int]:
        """Return those parameters that the poses can tell, the set-up's first and in the order given."""
        kept: list[int] = []
        whole = self.normal.sum(axis=0)
        for i in chosen:
            own = float(whole[i, i])
            if kept and own > 0.0:
                inner, across = whole[np.ix_(kept, kept)], whole[kept, i]
                own -= float(across @ np.linalg.lstsq(inner, across, rcond=1e-12)[0])
            if i < _SETUP or own > _LEAST_OWN**2:
                kept.append(i)
        return kept

    def left_out(self, chosen: Sequence[int]) -> Floats:
        """Return the sum of squares that is left in each block when it was held out, mm²."""
        whole, right = self.normal.sum(axis=0), self.right.sum(axis=0)
        index = np.ix_(chosen, chosen)
        left = np.empty(len(self.power))
        for block, (normal, to, power) in enumerate(zip(self.normal, self.right, self.power, strict=True)):
            inner = normal[index]
            value = np.linalg.lstsq(whole[index] - inner, right[chosen] - to[chosen], rcond=1e-12)[0]
            left[block] = power - 2.0 * (value @ to[chosen]) + value @ inner @ value
        return left


@dataclass(frozen=True)
class Parameter:
    """A fitted parameter; ``value`` and ``k2`` are NaN when the poses cannot tell it."""

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
    inverse = np.linalg.pinv(grams.normal.sum(axis=0)[index], rcond=1e-12, hermitian=True)
    value = inverse @ grams.right.sum(axis=0)[chosen]
    scores = np.array(
        [to[chosen] - normal[index] @ value for normal, to in zip(grams.normal, grams.right, strict=True)]
    )
    blocks = len(scores)
    spread = inverse @ (scores.T @ scores) @ inverse * (blocks / max(blocks - 1, 1))
    scale = grams.scale[list(chosen)]
    return value / scale, spread / np.outer(scale, scale)


def parameters(grams: Grams, terms: Sequence[Term]) -> list[Parameter]:
    """Return every parameter of some terms."""
    series = grams.series
    told = grams.told(series.chosen(terms))
    value, covariance = solve(grams, told)
    at = {i: n for n, i in enumerate(told)}
    out = []
    for term in terms:
        for offset, (name, unit) in enumerate(EFFECTS[term.effect].parameters):
            i = series.slots[term].start + offset
            if i >= series.slots[term].stop:
                continue
            n = at.get(i)
            at_value = float("nan") if n is None else float(value[n])
            k2 = float("nan") if n is None else 2.0 * float(np.sqrt(covariance[n, n]))
            out.append(Parameter(term, name, unit, at_value, k2))
    return out


def left_mm(grams: Grams, terms: Sequence[Term]) -> Floats:
    """Return what the terms leave of the errors, shape (n, 3)."""
    series = grams.series
    told = grams.told(series.chosen(terms))
    value, _ = solve(grams, told)
    return np.asarray(series.error_mm - series.design[:, :, told] @ value)


def held_out_mm(grams: Grams, terms: Sequence[Term]) -> Floats:
    """Return what the terms leave in blocks that were held out of the fit, shape (n, 3)."""
    series = grams.series
    told = grams.told(series.chosen(terms))
    left = np.empty_like(series.error_mm)
    whole, right, index = grams.normal.sum(axis=0), grams.right.sum(axis=0), np.ix_(told, told)
    for block, (normal, to) in enumerate(zip(grams.normal, grams.right, strict=True)):
        rows = series.block == block
        value = (
            np.linalg.lstsq(whole[index] - normal[index], right[told] - to[told], rcond=1e-12)[0] / grams.scale[told]
        )
        left[rows] = series.error_mm[rows] - series.design[rows][:, :, told] @ value
    return left
