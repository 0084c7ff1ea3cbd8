"""Runs that are not like their repeats."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from dtwin.physics._dictionary import Dictionary
from dtwin.physics._hunt import Hunt
from dtwin.physics.candidates import Candidates
from dtwin.physics.effect import Instance
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Problem
from dtwin.physics.whitening import from_harmonics, harmonic_numbers
from dtwin.schema import Floats

_RATIO = 12.0
# Along an axis: runs, and numbers of the curve of a sweep that is no part of what is odd.
_FEWEST_RUNS, _BENDS = 4, 4
_LOW_RATIO = 40.0
_LOW_HARMONICS = 13
_MOST_SHARE = 0.1
# A tone is a handful of numbers: two of three repeats lie close together by chance.
_FEWEST_POINTS = 100
# Two repeats differ by so many times what those of any other condition do, and so many conditions must be repeated.
_PAIR_RATIO, _FEWEST_PAIRS = 40.0, 4
# What comes and goes with a rhythm of its own, as lubrication does, is in both repeats: it shows in higher harmonics.
_PAIR_HARMONICS = slice(1, 6)


def odd_runs(problem: Problem) -> list[int]:
    """Return the rows that disagree with their repeats far more than these with each other.

    Looks at all harmonics together, and at each low one against what the other conditions show
    there. Needs three repeats of a condition; see ``odd_of_two``. At most a
    tenth of the runs is called odd, the worst ones; beyond that the campaign is noisy, not spoilt.
    """
    obs = problem.obs
    if obs.there_and_back:
        return _odd_sweeps(problem)
    if problem.noise is None or obs.n_bins < _FEWEST_POINTS:
        return []
    parts = _parts(problem)
    rows, gaps, spreads = [], [], []
    for condition in range(len(obs.conditions)):
        members = np.flatnonzero(obs.condition_of == condition)
        for row in members if len(members) > 2 else ():
            others = members[members != row]
            measures = [_gap_and_spread(part[row], part[others]) for part in parts]
            rows.append(int(row))
            gaps.append([gap for gap, _ in measures])
            spreads.append([spread for _, spread in measures])
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


def _odd_sweeps(problem: Problem) -> list[int]:
    """Return the rows of the run along an axis that is rougher than all others, as of one that was knocked or read through stirred air.

    What warms up, drifts and creeps bends whole sweeps: a curve of third order of each is no part of it.
    """
    obs = problem.obs
    if obs.n_bins <= 2 * _BENDS or not obs.mask.all():
        return []
    low, high = obs.grid.points.min(), obs.grid.points.max()
    along = (2.0 * obs.grid.points - low - high) / (high - low)
    bends = np.linalg.qr(np.polynomial.legendre.legvander(along, _BENDS - 1))[0]
    plain = from_harmonics(problem.residual / problem.weights)
    rough = plain - (plain @ bends) @ bends.T
    alike: dict[tuple[int, ...], list[list[int]]] = {}
    for run in range(int(obs.run_of.max()) + 1):
        rows = sorted(np.flatnonzero(obs.run_of == run).tolist(), key=lambda row: int(obs.condition_of[row]))
        alike.setdefault(tuple(obs.condition_of[rows].tolist()), []).append(rows)
    ratios: list[tuple[float, list[int]]] = []
    for runs in (runs for runs in alike.values() if len(runs) >= _FEWEST_RUNS):
        sweeps = rough[runs].reshape(len(runs), -1)
        for number, rows in enumerate(runs):
            gap, spread = _gap_and_spread(sweeps[number], np.delete(sweeps, number, axis=0))
            ratios.append((gap / max(spread, 1e-300), rows))
    ratio, worst = max(ratios, default=(0.0, []))
    return worst if ratio > _RATIO else []


def odd_of_two(problem: Problem, tried: Sequence[Instance], again: Callable[[Observations], Problem]) -> list[int]:
    """Return the row of the only two repeats that disagree: the one without which effects leave less.

    ``tried``: effects that may be missing.
    ``again``: makes the problem of other runs of the campaign.
    """
    obs = problem.obs
    if problem.noise is None or obs.n_bins < _FEWEST_POINTS:
        return []
    members = [np.flatnonzero(obs.condition_of == condition) for condition in range(len(obs.conditions))]
    repeated = [rows for rows in members if len(rows) > 1]
    if len(repeated) < _FEWEST_PAIRS:
        return []
    parts = _parts(problem)[_PAIR_HARMONICS]
    spreads = np.array([[part[rows].var(axis=0, ddof=1).sum() for part in parts] for rows in repeated])
    second, largest = np.sort(spreads, axis=0)[-2:]
    # A centre that is each run's own does not differ.
    beyond = largest - _PAIR_RATIO * np.maximum(second, np.median(second))
    for band in np.argsort(-beyond):
        rows = repeated[int(np.argmax(spreads[:, band]))]
        if beyond[band] > 0.0 and len(rows) == 2:
            left = {}
            for row in rows.tolist():
                rest = again(obs.without([row]))
                hunt = Hunt(rest, Dictionary(rest, Candidates(rest.obs, tried)))
                left[row] = hunt.left(hunt.run([]))
            return [min(left, key=left.__getitem__)]
    return []


def _parts(problem: Problem) -> list[Floats]:
    """Return what is compared between repeats: all harmonics, whitened, and each low one."""
    harmonic = harmonic_numbers(problem.obs.n_bins)
    # Unweighted: a spoilt harmonic would have lost its weight through the run that spoils it.
    plain = problem.residual / problem.weights
    return [problem.residual, *(plain[:, harmonic == h] for h in range(_LOW_HARMONICS))]


def _gap_and_spread(row: np.ndarray, others: np.ndarray) -> tuple[float, float]:
    n = len(others)
    mean = others.mean(axis=0)
    spread = float(((others - mean) ** 2).sum()) / (n - 1)
    return float(((row - mean) ** 2).sum()) * n / (n + 1), spread
