"""Runs that are not like their repeats."""

from __future__ import annotations

import numpy as np

from dtwin.physics.problem import Problem
from dtwin.physics.whitening import harmonic_numbers

_RATIO = 12.0
_LOW_RATIO = 40.0
_LOW_HARMONICS = 13
_MOST_SHARE = 0.1
# A tone is a handful of numbers: two of three repeats lie close together by chance.
_FEWEST_POINTS = 100


def odd_runs(problem: Problem) -> list[int]:
    """Return the rows that disagree with their repeats far more than these with each other.

    Looks at all harmonics together, and at each low one against what the other conditions show
    there. Needs three repeats of a condition: of two, nobody knows which one is wrong. At most a
    tenth of the runs is called odd, the worst ones; beyond that the campaign is noisy, not spoilt.
    """
    obs = problem.obs
    if problem.noise is None or obs.n_bins < _FEWEST_POINTS:
        return []
    harmonic = harmonic_numbers(obs.n_bins)
    # Unweighted: a spoilt harmonic would have lost its weight through the run that spoils it.
    plain = problem.residual / problem.weights
    bands = [harmonic >= 0, *(harmonic == h for h in range(_LOW_HARMONICS))]
    rows, gaps, spreads = [], [], []
    for condition in range(len(obs.conditions)):
        members = np.flatnonzero(obs.condition_of == condition)
        for row in members if len(members) > 2 else ():
            others = members[members != row]
            values = (problem.residual, *[plain] * _LOW_HARMONICS)
            found = [_gap_and_spread(v[row][band], v[others][:, band]) for v, band in zip(values, bands, strict=True)]
            rows.append(int(row))
            gaps.append([gap for gap, _ in found])
            spreads.append([spread for _, spread in found])
    if not rows:
        return []
    gap, spread = np.array(gaps), np.maximum(np.array(spreads), 1e-300)
    own = gap / spread
    typical = gap / np.median(spread, axis=0)
    worst = np.minimum(own, typical / (_LOW_RATIO / _RATIO))
    worst[:, 0] = own[:, 0]
    score = worst.max(axis=1)
    order = [i for i in np.argsort(-score) if score[i] > _RATIO]
    return [rows[i] for i in order[: max(1, int(_MOST_SHARE * obs.n_rows))]]


def _gap_and_spread(row: np.ndarray, others: np.ndarray) -> tuple[float, float]:
    n = len(others)
    mean = others.mean(axis=0)
    spread = float(((others - mean) ** 2).sum()) / (n - 1)
    return float(((row - mean) ** 2).sum()) * n / (n + 1), spread
