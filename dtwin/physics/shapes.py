"""Shape parameters: variable projection, the linear part solved for each try."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import least_squares

from dtwin.physics.candidates import Candidates
from dtwin.physics.problem import Problem, Term, orthonormal
from dtwin.schema import Floats

_MOST_TRIES = 12
_MOST_TOGETHER = 8
_MARGIN = 1e-3
_ABSENT = 1e-6


def refined(problem: Problem, term: Term, *, bounded: bool = False) -> Term:
    """Return a term with the shape near its own that leaves least.

    Parameters
    ----------
    problem : Problem
        Campaign with everything else that is known.
    term : Term
        Effect and the shape to start from.
    bounded : bool
        Stay within the grid of the effect, as diagnosis does. Beyond it many effects turn into
        others: friction without travel and a spike without end are backlash. Otherwise within
        what is physically possible.

    Returns
    -------
    Term
        The same when no other shape is better, or when the effect has none.
    """
    names = [shape.name for shape in term.instance.effect.shapes]
    if not names:
        return term
    # Its own cache, dropped afterwards: hardly any shape is asked for twice.
    candidates = Candidates(problem.obs, [term.instance])
    residual = problem.residual.ravel()

    def left(logs: Floats) -> Floats:
        shape = dict(zip(names, np.exp(logs), strict=True))
        visible = candidates.visible(problem, replace(term, shape=shape))
        return np.asarray(residual - visible @ (visible.T @ residual))

    begun = np.log([term.shape[name] for name in names])
    found = least_squares(
        left,
        begun,
        bounds=_bounds(term, begun, bounded),
        method="trf",
        x_scale="jac",
        max_nfev=_MOST_TRIES,
        diff_step=[1e-4] * len(names),
    )
    if found.cost >= 0.5 * float((left(begun) ** 2).sum()):
        return term
    return replace(term, shape=dict(zip(names, np.exp(found.x).tolist(), strict=True)))


def refined_together(
    problem: Problem, candidates: Candidates, terms: Sequence[Term]
) -> tuple[Term, ...]:
    """Return terms with the shapes, within their grids, that leave least when all are fitted.

    Parameters
    ----------
    problem : Problem
        Campaign with what is known besides.
    candidates : Candidates
        The library.
    terms : sequence of Term
        Effects with the shapes to start from.
    """
    shaped = [term for term in terms if term.instance.effect.shapes]
    if not shaped:
        return tuple(terms)
    for term in terms:
        if not term.instance.effect.shapes:
            visible = candidates.visible(problem, term)
            problem = problem.extended(visible, candidates.whitened(problem, term))
    residual = problem.residual.ravel()
    sizes = [len(term.instance.effect.shapes) for term in shaped]
    ends = np.cumsum(sizes)
    # The solver changes one shape at a time and comes back.
    kept: dict[tuple[int, bytes], Floats] = {}

    def columns(number: int, logs: Floats) -> Floats:
        key = number, logs.tobytes()
        if key not in kept:
            term = _at(shaped[number], logs)
            whitened = problem.whitened(problem.obs.regressors(term.instance, term.shape))
            kept[key] = whitened - problem.basis @ (problem.basis.T @ whitened)
        return kept[key]

    def left(logs: Floats) -> Floats:
        parts = [
            columns(n, logs[end - size : end])
            for n, (size, end) in enumerate(zip(sizes, ends, strict=True))
        ]
        visible = orthonormal(np.concatenate(parts, axis=1))
        return np.asarray(residual - visible @ (visible.T @ residual))

    begun = np.log([term.shape[s.name] for term in shaped for s in term.instance.effect.shapes])
    bounds = [
        _bounds(t, begun[e - n : e], True) for t, n, e in zip(shaped, sizes, ends, strict=True)
    ]
    low, high = np.concatenate([b[0] for b in bounds]), np.concatenate([b[1] for b in bounds])
    found = least_squares(
        left, begun, bounds=(low, high), method="trf", x_scale="jac", max_nfev=_MOST_TOGETHER,
        diff_step=[1e-4] * len(begun), ftol=1e-4,
    )  # fmt: skip
    if found.cost >= 0.5 * float((left(begun) ** 2).sum()):
        return tuple(terms)
    new = {t.label: _at(t, found.x[e - n : e]) for t, n, e in zip(shaped, sizes, ends, strict=True)}
    return tuple(new.get(term.label, term) for term in terms)


def _at(term: Term, logs: Floats) -> Term:
    names = [shape.name for shape in term.instance.effect.shapes]
    return replace(term, shape=dict(zip(names, np.exp(logs).tolist(), strict=True)))


def _bounds(term: Term, begun: Floats, within_grid: bool) -> tuple[Floats, Floats]:
    """Return the range of each shape in logarithms; the solver wants a start inside."""
    ranges = [
        (min(shape.grid), max(shape.grid)) if within_grid and shape.grid else shape.bounds
        for shape in term.instance.effect.shapes
    ]
    low, high = np.log(np.maximum(ranges, _ABSENT)).T
    return np.minimum(low, begun) - _MARGIN, np.maximum(high, begun) + _MARGIN
