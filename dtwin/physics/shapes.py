"""Shape parameters: variable projection, the linear part solved for each try."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.optimize import least_squares

from dtwin.physics.candidates import Candidates
from dtwin.physics.problem import Problem, Term
from dtwin.schema import Floats

_MOST_TRIES = 12
_MARGIN = 1e-3


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
        x_scale=0.1,
        max_nfev=_MOST_TRIES,
        diff_step=[1e-4] * len(names),
    )
    if found.cost >= 0.5 * float((left(begun) ** 2).sum()):
        return term
    return replace(term, shape=dict(zip(names, np.exp(found.x).tolist(), strict=True)))


def _bounds(term: Term, begun: Floats, within_grid: bool) -> tuple[Floats, Floats]:
    """Return the range of each shape in logarithms; the solver wants a start inside."""
    ranges = [
        (min(shape.grid), max(shape.grid)) if within_grid and shape.grid else shape.bounds
        for shape in term.instance.effect.shapes
    ]
    low, high = np.log(np.array(ranges)).T
    return np.minimum(low, begun) - _MARGIN, np.maximum(high, begun) + _MARGIN
