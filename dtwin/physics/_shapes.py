"""Shape parameters: variable projection, the linear part solved for each try."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy

from dtwin.physics._condensed import Condensed
from dtwin.physics.effect import ShapeParameter
from dtwin.physics.problem import Term
from dtwin.schema import Floats

_FEW, _MOST = 8, 60
# Of logarithms: a solver ends so far outside of its range.
_MARGIN = 1e-3
_ABSENT = 1e-6
_NEAR_ABSENT = 1e-2


def refined(
    campaign: Condensed, terms: Sequence[Term], enough: float = 0.0, *, bounded: bool = False
) -> tuple[Term, ...]:
    """Return terms with the shapes that leave least when all are fitted.

    ``campaign``: with what is known besides.
    ``terms``: effects with the shapes to start from.
    ``enough``: a step that lowers the sum of squares by less is the last one.
    ``bounded``: stay within the grids, as diagnosis does, and take few steps. Beyond them many effects turn into others:
    friction without travel and a spike without end are backlash. Otherwise, and where the error is as large, within what
    is physically possible.
    The same terms when no other shapes are better, or when none has any.
    """
    several = campaign.problem.obs.several_speeds
    shaped = [term for term in terms if term.instance.effect.refined_shapes(several)]
    if not shaped:
        return tuple(terms)
    campaign = campaign.given(term for term in terms if term not in shaped)
    free = [term.instance.effect.refined_shapes(several) for term in shaped]
    sizes = [len(shapes) for shapes in free]
    parts = [slice(end - n, end) for end, n in zip(np.cumsum(sizes), sizes, strict=True)]
    projected = _Projected(campaign, shaped, free, parts)
    begun = np.concatenate([_logs(term, shapes) for term, shapes in zip(shaped, free, strict=True)])
    sizes_um = projected.sizes(begun)
    ranges = [_bounds(shapes, begun[part], bounded, um) for shapes, part, um in zip(free, parts, sizes_um, strict=True)]
    low, high = (np.concatenate(ends) for ends in zip(*ranges, strict=True))
    before = float((projected.left(begun) ** 2).sum())
    solution = scipy.optimize.least_squares(
        projected.left,
        begun,
        projected.slopes,
        bounds=(low, high),
        x_scale="jac",
        max_nfev=_FEW if bounded else _MOST,
        ftol=max(1e-6, min(0.1, enough / max(before, 1e-300))),
    )
    if 2.0 * solution.cost >= before:
        return tuple(terms)
    new = {t.label: _at(t, shapes, solution.x[part]) for t, shapes, part in zip(shaped, free, parts, strict=True)}
    return tuple(new.get(term.label, term) for term in terms)


def is_too_long(campaign: Condensed, term: Term) -> bool:
    """Tell whether a shape that is as large as the error is much larger than that: a play of a third of a micrometre with a standstill of 300."""
    shapes = [shape for shape in term.instance.effect.shapes if shape.as_large]
    if not shapes:
        return False
    (own,), _, _ = _Projected(campaign, [term], [()], [slice(0)]).amplitudes([term])
    return any(term.shape[shape.name] > shape.largest_at(float(own[0])) for shape in shapes)


class _Projected:
    """What effects leave as their shapes change, all amplitudes fitted, and its slopes after Kaufman (1975).

    Residual and slopes are turned together into as few rows as there are slopes, and one more: no product changes, and
    the solver's decompositions become small.
    """

    def __init__(
        self,
        campaign: Condensed,
        terms: Sequence[Term],
        free: Sequence[Sequence[ShapeParameter]],
        parts: Sequence[slice],
    ) -> None:
        self._campaign, self._terms, self._free, self._parts = campaign, terms, free, parts
        self._residual = campaign.residual
        self._turned: dict[bytes, Floats] = {}
        self._last: tuple[bytes, tuple[list[Floats], Floats, Floats]] | None = None

    def left(self, logs: Floats) -> Floats:
        """Return the residual, shape (shapes + 1,)."""
        return self._both(logs)[:, -1]

    def sizes(self, logs: Floats) -> list[float]:
        """Return the first parameter of each effect."""
        own, _, _ = self._fitted(logs)
        return [float(amplitudes[0]) for amplitudes in own]

    def slopes(self, logs: Floats) -> Floats:
        """Return how the residual changes with every logarithm of a shape, shape (shapes + 1, shapes)."""
        return self._both(logs)[:, :-1]

    def _both(self, logs: Floats) -> Floats:
        key = logs.tobytes()
        if key not in self._turned:
            self._turned[key] = np.asarray(np.linalg.qr(self._evaluated(logs), mode="r"), float)
        return self._turned[key]

    def _evaluated(self, logs: Floats) -> Floats:
        """Return slopes and, at last, the residual, shape (m, shapes + 1)."""
        own, columns, inverse = self._fitted(logs)
        changes = [
            self._campaign.slope(term, shape.name) @ a
            for term, free, a in zip(self._shaped(logs), self._free, own, strict=True)
            for shape in free
        ]
        slopes = self._seen(np.stack(changes, axis=1))
        slopes -= columns @ (inverse @ (columns.T @ slopes))
        return np.column_stack([-slopes, self._residual - columns @ np.concatenate(own)])

    def _shaped(self, logs: Floats) -> list[Term]:
        return [_at(t, free, logs[part]) for t, free, part in zip(self._terms, self._free, self._parts, strict=True)]

    def _fitted(self, logs: Floats) -> tuple[list[Floats], Floats, Floats]:
        """Return the amplitudes at these shapes; where a search begins they are asked for twice."""
        key = logs.tobytes()
        if self._last is None or self._last[0] != key:
            self._last = key, self.amplitudes(self._shaped(logs))
        return self._last[1]

    def amplitudes(self, terms: Sequence[Term]) -> tuple[list[Floats], Floats, Floats]:
        """Return what is fitted of each effect, its columns beside what is known, (m, k), and the inverse of their products."""
        every = [self._campaign.columns_between(term) for term in terms]
        columns = self._seen(np.concatenate(every, axis=1))
        inverse = np.asarray(np.linalg.pinv(columns.T @ columns, rcond=1e-10, hermitian=True), float)
        amplitude = inverse @ (columns.T @ self._residual)
        return np.split(amplitude, np.cumsum([made.shape[1] for made in every])[:-1]), columns, inverse

    def _seen(self, vectors: Floats) -> Floats:
        """Return vectors without what the known effects could be, shape (m, k)."""
        basis = self._campaign.basis
        return np.asarray(vectors - basis @ (basis.T @ vectors))


def _at(term: Term, free: Sequence[ShapeParameter], logs: Floats) -> Term:
    new = {shape.name: value for shape, value in zip(free, np.exp(logs).tolist(), strict=True)}
    return replace(term, shape=term.instance.effect.start_shape | dict(term.shape) | new)


def _logs(term: Term, free: Sequence[ShapeParameter]) -> Floats:
    shape = term.instance.effect.start_shape | dict(term.shape)
    return np.log(np.maximum([shape[s.name] for s in free], _ABSENT))


def possible(shape: ShapeParameter, size: float) -> tuple[float, float]:
    """Return the bounds of a shape of an effect of a size, both above zero: what may be absent begins where it is as good as that."""
    low = max(shape.bounds[0], _NEAR_ABSENT * min(shape.grid or (shape.start,)), _ABSENT)
    return low, shape.largest_at(size)


def _least(shape: ShapeParameter) -> float:
    """Return the smallest value of a grid; far less where the effect stays the same, so that the solver does not stick there."""
    return min(shape.grid) * (_NEAR_ABSENT if shape.vanishes else 1.0)


def _bounds(free: Sequence[ShapeParameter], begun: Floats, within_grid: bool, size: float) -> tuple[Floats, Floats]:
    """Return the range of each shape of an effect of a size in logarithms; the solver wants a start inside."""
    ranges = [
        (_least(s), s.largest_at(size) if s.as_large else max(s.grid))
        if within_grid and s.grid
        else (s.bounds[0], s.largest_at(size))
        for s in free
    ]
    low, high = np.log(np.maximum(ranges, _ABSENT)).T
    return np.minimum(low, begun) - _MARGIN, np.maximum(high, begun) + _MARGIN
