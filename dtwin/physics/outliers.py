"""Runs that are not like their repeats."""

from __future__ import annotations

import numpy as np

from dtwin.physics.problem import Problem

_RATIO = 12.0
_MOST_SHARE = 0.1


def odd_runs(problem: Problem) -> list[int]:
    """Return the rows that disagree with their repeats far more than these with each other.

    Parameters
    ----------
    problem : Problem
        Whitened campaign.

    Notes
    -----
    Needs three repeats of a condition: of two, nobody knows which one is wrong. At most a tenth
    of the runs is called odd, the worst ones; beyond that the campaign is noisy, not spoilt.
    """
    obs, residual = problem.obs, problem.residual
    if problem.noise is None:
        return []
    ratios: dict[int, float] = {}
    for condition in range(len(obs.conditions)):
        rows = np.flatnonzero(obs.condition_of == condition)
        if len(rows) < 3:
            continue
        for row in rows:
            others = residual[rows[rows != row]]
            n = len(others)
            spread = ((others - others.mean(axis=0)) ** 2).sum() / (n - 1)
            gap = ((residual[row] - others.mean(axis=0)) ** 2).sum() * n / (n + 1)
            ratios[int(row)] = float(gap / max(spread, 1e-300))
    odd = sorted((row for row in ratios if ratios[row] > _RATIO), key=lambda row: -ratios[row])
    return odd[: max(1, int(_MOST_SHARE * obs.n_rows))] if odd else []
