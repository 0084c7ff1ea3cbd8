"""How uncertain fitted parameters are: what repeats disagree by, and what the laws miss."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dtwin.physics._score import misfit, noise_level
from dtwin.physics.candidates import probes
from dtwin.physics.problem import Problem, Term, weighted_like
from dtwin.physics.whitening import condition_sums, within_condition, zero_weighted
from dtwin.schema import Floats
from dtwin.statistics import k2_factor

# Of a parameter, the share of its information that must be left when a condition is taken out.
_SUPPORTED = 1e-6
# Conditions of a jackknife.
_FEWEST = 5


def expanded(problem: Problem, terms: Sequence[Term], columns: Floats, x: Floats) -> Floats:
    """Return expanded uncertainties, k = 2.

    The unit of replication is the run: the spread of the scores of repeats is an estimate of the
    noise that holds whatever the noise looks like round the circle; the few degrees of freedom
    widen the interval as Student's t does (GUM, annex G). Where the laws miss more than the noise,
    runs of one condition err alike, and the unit is the condition.

    ``problem``: the campaign, not whitened by its noise.
    ``columns``, (rows * n, k): set-up terms and effects.
    ``x``, (k,): what was fitted.
    Returns (k,): NaN without repeats.
    """
    if problem.noise is None:
        return np.full(columns.shape[1], np.nan)
    obs = problem.obs
    size = np.sqrt((columns**2).sum(axis=0))
    scaled = columns / np.where(size > 0.0, size, 1.0)
    inverse = np.linalg.pinv(scaled.T @ scaled, rcond=1e-10, hermitian=True)
    influence = (scaled @ inverse).reshape(obs.n_rows, obs.n_bins, -1)
    left = (problem.y - columns @ x).reshape(obs.n_rows, obs.n_bins)
    deviation, count = within_condition(left, obs.condition_of)
    scores = np.einsum("nqk,nq->nk", influence, deviation)
    runs = np.zeros((int(obs.run_of.max()) + 1, scores.shape[1]))
    np.add.at(runs, obs.run_of, scores)
    # Conditions without repeats add no score: scale up for them.
    share = (count > 1).sum() / obs.n_rows
    clustered = (runs**2).sum(axis=0) / share
    white = weighted_like(obs, terms, problem.noise)
    level = noise_level(white, probes(white))
    variance = np.nan_to_num(problem.noise.variance, nan=float(np.nanmean(problem.noise.variance)))
    noise = problem.noise
    coloured = zero_weighted(influence / noise.weights[:, None], obs.run_of, 1.0 / noise.zero_weight)
    foretold = level.ratio * np.einsum("n,nqk,nqk->k", variance[obs.condition_of], coloured, coloured)
    dof = float(problem.noise.dof)
    blended = (dof * clustered + level.prior_dof * foretold) / (dof + level.prior_dof)
    out = k2_factor(dof + level.prior_dof) * np.sqrt(blended)
    if misfit(white) is not None:
        out = np.maximum(out, _by_condition(problem, scaled, influence, left))
    return np.asarray(out / np.where(size > 0.0, size, np.nan))


def _by_condition(problem: Problem, scaled: Floats, influence: Floats, left: Floats) -> Floats:
    """Return expanded uncertainties with the condition as the unit, in scaled columns, shape (k,).

    Two parts: the jackknife, each condition left out once, where there are enough for one; and what
    a misfit of the observed covariance between conditions would do at harmonics at which it is not
    fitted away.
    """
    condition_of = problem.obs.condition_of
    number = int(condition_of.max()) + 1
    few = number < _FEWEST
    jackknife = 0.0 if few else _jackknife(scaled.reshape(influence.shape), left, condition_of)
    means = condition_sums(left, condition_of) / np.bincount(condition_of)[:, None]
    together = means @ means.T / means.shape[1]
    summed = condition_sums(influence, condition_of)
    coherent = np.einsum("iqk,ij,jqk->k", summed, together, summed, optimize=True)
    factor = 2.0 if few else k2_factor(number - 1.0)
    return np.asarray(factor * np.sqrt(np.maximum(jackknife + coherent, 0.0)))


def _jackknife(rows: Floats, left: Floats, condition_of: NDArray[np.int64]) -> Floats:
    """Return the variance of what is fitted, each condition left out once, shape (k,)."""
    number = int(condition_of.max()) + 1
    grams = np.zeros((number, rows.shape[2], rows.shape[2]))
    sides = np.zeros((number, rows.shape[2]))
    for row, condition in enumerate(condition_of):
        grams[condition] += rows[row].T @ rows[row]
        sides[condition] += rows[row].T @ left[row]
    whole = grams.sum(axis=0)
    moved = np.zeros_like(sides)
    for n in range(number):
        rest = whole - grams[n]
        supported = np.diag(rest) > _SUPPORTED * np.diag(whole)
        change = np.linalg.pinv(rest, rcond=1e-10, hermitian=True) @ (sides.sum(axis=0) - sides[n])
        moved[n, supported] = change[supported]
    return np.asarray((number - 1) / number * (moved**2).sum(axis=0))
