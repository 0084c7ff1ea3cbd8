"""Tests whose unit of replication is the run: score test, lack of fit, shared noise level."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import polygamma

from dtwin.physics._few_runs import along, inside, smooth_share
from dtwin.physics.gridding import Indices
from dtwin.physics.problem import Problem
from dtwin.physics.whitening import (
    SEPARATE,
    condition_sums,
    from_harmonics,
    harmonic_numbers,
    inverse_root,
    smoothed,
    within_condition,
)
from dtwin.schema import Floats
from dtwin.statistics import f_tail

HIGHEST_HARMONIC = 60
# All together, in ranges, and one by one where most effects live.
_BANDS = ((0, HIGHEST_HARMONIC), (0, 4), (5, 12), (13, 30), (31, HIGHEST_HARMONIC), *((h, h) for h in range(13)))
_CIRCLE = 360
_FLIPS = 1999
_DRAWS, _AT_A_TIME = 499, 50
_FEW_DOF = 12
_MOST_PRIOR = 1.0
# Less than this share of the noise is no misfit.
_MISFIT = 0.05
_SURE = 3.0


@dataclass(frozen=True)
class Score:
    """Result of a score test.

    ``p_value``: of the hypothesis that the columns explain nothing.
    ``gain``: explained sum of squares beyond what noise would explain.
    ``expected``: sum of squares that noise alone would explain.
    ``dof``: degrees of freedom of the noise estimate.
    """

    p_value: float
    gain: float
    expected: float
    dof: float


@dataclass(frozen=True)
class NoiseLevel:
    """How well the noise level of each condition foretells the noise of a score.

    ``prior_dof``: weight of the level of the conditions, in degrees of freedom: large when the noise is alike round the
    circle, zero when it is not. After Smyth (2004), moderated t-statistics.
    ``ratio``: typical score variance over the one foretold.
    ``misfit``, (n,): variance, at every coefficient, of what repeats agree on though no effect explains it: laws that
    are not exact. It counts as noise that the repeats of a condition share.
    """

    prior_dof: float = 0.0
    ratio: float = 1.0
    misfit: Floats | None = None


def score_test(
    problem: Problem, visible: Floats, residual: Floats, level: NoiseLevel, *, within: bool = False
) -> Score:
    """Test whether columns explain the residual, the run being the unit of replication.

    ``visible``, (rows * n, k): orthonormal columns, orthogonal to what is known.
    ``residual``, (rows, n): whitened residual.
    ``level``: what other scores tell of the noise.
    ``within``: the columns differ between repeats of a condition.
    """
    obs = problem.obs
    if obs.there_and_back:
        return _of_few(problem, visible, residual, level, within)
    k = visible.shape[1]
    z = visible.reshape(obs.n_rows, obs.n_bins, k)
    total = visible.T @ residual.ravel()
    noise = residual
    if within:
        noise = residual - (visible @ total).reshape(residual.shape)
    deviation, count = within_condition(noise, obs.condition_of)
    scores = np.einsum("nqk,nq->nk", z, deviation)
    unit, group = (obs.clusters, obs.place_of) if within else (obs.run_of, obs.condition_of)
    summed = np.zeros((int(unit.max()) + 1, k))
    np.add.at(summed, unit, scores)
    variance = summed.T @ summed
    power = (summed**2).sum(axis=1, keepdims=True)
    # Columns in different harmonics do not take their degrees of freedom from each other.
    lost = int(np.ceil((z**2).sum(axis=(0, 2)).max() - 1e-6)) if within else 0
    dof = float(_satterthwaite(power, unit, group, count, lost=lost)[0])
    told = replace(level, prior_dof=_prior_dof(problem, z, level.prior_dof))
    variance, dof = _moderated(variance, dof, _foretold(problem, z), told)
    if level.misfit is not None and not within:
        shared = condition_sums(z, obs.condition_of)
        variance = variance + np.einsum("cqk,cql,q->kl", shared, shared, level.misfit)
    expected = float(np.trace(variance))
    if dof < 1.0 or expected <= 0.0:
        return Score(1.0, 0.0, expected, dof)
    explained = float(total @ total)
    if dof < k:
        # More columns than runs tell of: they count as so many as their noise varies in (Greenhouse and Geisser 1959).
        many = expected**2 / float((variance**2).sum())
        p_value = f_tail(explained / expected, (many, many * dof))
    else:
        f = float(total @ np.linalg.pinv(variance) @ total) / k
        left = max(dof - k + 1.0, 1.0)
        p_value = f_tail(f * left / dof, (k, left))
    return Score(p_value=p_value, gain=max(0.0, explained - expected), expected=expected, dof=dof)


def _prior_dof(problem: Problem, z: Floats, most: float) -> float:
    """Return the degrees of freedom that the noise level adds to those of the runs, for columns of shape (rows, n, k).

    Where repeats are few, the level of a low harmonic, which is its own, is known by its cosine and its sine alone, and that
    of harmonic 0 by no more than the scores of the runs tell.
    """
    if problem.noise is None or problem.noise.dof >= _FEW_DOF:
        return most
    power = np.bincount(harmonic_numbers(problem.obs.n_bins), (z**2).sum(axis=(0, 2)))
    weights = np.full(len(power), most)
    weights[:SEPARATE] = min(most, float(problem.noise.dof))
    weights[0] = 0.0
    return float(weights @ power / max(float(power.sum()), 1e-300))


def _of_few(problem: Problem, visible: Floats, residual: Floats, level: NoiseLevel, within: bool) -> Score:
    """Return the score of a handful of runs, each of which passes every place twice.

    What differs between runs has no noise level to lean on: forward and back share what a run is
    off by. Nor have lines and bows, along which the air wanders from one end to the other. The columns count as so many as their noise varies in (Greenhouse and Geisser 1959), so
    that an effect of eight numbers can be tested on five runs.
    """
    obs = problem.obs
    z = inside(visible, obs) if within else visible
    k = z.shape[1]
    if not k:
        return Score(1.0, 0.0, 0.0, 0.0)
    total = z.T @ residual.ravel()
    # Beside drift an effect that stays is not quite the same in all runs: what it does goes out, too.
    noise = residual - (z @ total).reshape(residual.shape)
    deviation, count = within_condition(noise, obs.condition_of)
    by_row = z.reshape(obs.n_rows, obs.n_bins, k)
    runs = int(obs.run_of.max()) + 1
    if within:
        # How much of the column's form is in each run; runs are alike, whatever their share of it.
        scores = np.stack([along(by_row[:, :, j], deviation, obs) for j in range(k)], axis=1)
        dof = float(runs - 1 - k)
        variance = scores.T @ scores * (runs - 1) / runs / max(dof, 1.0)
    else:
        scores = np.zeros((runs, k))
        np.add.at(scores, obs.run_of, np.einsum("nqk,nq->nk", by_row, deviation))
        variance = scores.T @ scores
        power = (scores**2).sum(axis=1, keepdims=True)
        dof = float(_satterthwaite(power, obs.run_of, obs.condition_of, count, lost=0)[0])
        told = replace(level, prior_dof=level.prior_dof * (1.0 - smooth_share(problem, z)))
        variance, dof = _moderated(variance, dof, _foretold(problem, by_row), told)
    expected = float(np.trace(variance))
    if dof < 1.0 or expected <= 0.0:
        return Score(1.0, 0.0, expected, dof)
    explained, many = float(total @ total), expected**2 / float((variance**2).sum())
    p_value = f_tail(explained / expected, (many, many * dof))
    return Score(p_value, max(0.0, explained - expected), expected, dof)


def noise_level(problem: Problem, probes: Floats) -> NoiseLevel:
    """Learn from probes whether the noise is alike round the circle.

    ``probes``, (rows * n, k): columns, constant inside a condition, orthogonal to what is known, each of length one.
    """
    obs = problem.obs
    deviation, count = within_condition(problem.residual, obs.condition_of)
    z = probes.reshape(obs.n_rows, obs.n_bins, -1)
    scores = np.einsum("nqk,nq->nk", z, deviation)
    summed = np.zeros((int(obs.run_of.max()) + 1, scores.shape[1]))
    np.add.at(summed, obs.run_of, scores)
    local = problem.local_variance
    angle = from_harmonics(z)
    foretold = np.einsum("nq,nqk,nqk->k", local, angle, angle)
    power = (summed**2).sum(axis=0)
    usable = (power > 0) & (foretold > 0)
    if usable.sum() < 8:
        return NoiseLevel()
    dofs = _satterthwaite(summed[:, usable] ** 2, obs.run_of, obs.condition_of, count, lost=0)
    logs = np.log(power[usable] / foretold[usable])
    bias = np.log(dofs / 2.0) - polygamma(0, dofs / 2.0)
    spread = float(np.var(logs, ddof=1) - np.mean(polygamma(1, dofs / 2.0)))
    # With few repeats the tests lean on noise that is taken to be alike in all conditions.
    most = max(_MOST_PRIOR * float(np.median(dofs)), float(_FEW_DOF))
    prior = most if spread <= 0.0 else min(most, 2.0 / max(spread, 1e-6) + 1.0)
    return NoiseLevel(prior, float(np.exp(np.mean(logs + bias))))


def misfit(problem: Problem) -> Floats | None:
    """Return the variance of what repeats agree on though nothing known explains it.

    ``problem``: whitened campaign with all that was found.
    Returns (n,): of every whitened coefficient of a condition; None where it is no more than the noise.
    """
    obs = problem.obs
    rows = problem.residual
    count = np.bincount(obs.condition_of)
    repeated = count > 1
    means = condition_sums(rows, obs.condition_of)[repeated] / count[repeated, None]
    deviation, of = within_condition(rows, obs.condition_of)
    if not repeated.any():
        return None
    pure = (deviation[of > 1] ** 2).mean(axis=0)
    of_mean = pure * (1.0 / count[repeated]).mean()
    shared = smoothed((means**2).mean(axis=0) - of_mean)
    # Gaussian noise alone varies by so much.
    chance = float(np.sqrt(2.0 * len(pure) / len(means)) * of_mean.mean())
    certain = shared.sum() > max(_MISFIT * pure.mean() * len(pure), _SURE * chance)
    return np.maximum(shared, 0.0) if certain else None


def lack_of_fit(problem: Problem, residual: Floats, seed: int) -> float:
    """Test whether repeats agree on anything that the twin does not explain.

    Products of different runs of one condition have mean zero under noise of any shape; runs
    change sign at random for the comparison.

    ``residual``, (rows, n): whitened residual.
    """
    obs = problem.obs
    pairs = _pairs(obs.condition_of, obs.run_of)
    bands = _bands(obs.n_bins)
    rng = np.random.default_rng(seed)
    runs = int(obs.run_of.max()) + 1
    n_conditions = len(set(obs.condition_of.tolist()))
    if runs - n_conditions >= _FEW_DOF:
        grams = np.array([(residual[:, band] @ residual[:, band].T) * pairs for band in bands])
        agreed = grams.sum(axis=(1, 2))
        signs = rng.choice([-1.0, 1.0], size=(_FLIPS, runs))[:, obs.run_of]
        drawn = np.array([((signs @ gram) * signs).sum(axis=1) for gram in grams]).T
    else:
        agreed = _agreed(residual[:, None], obs.condition_of, pairs, bands)[0]
        drawn = _gaussian_draws(problem, pairs, bands, rng)
    # The largest of the standardised bands, against the same of the draws.
    centre, scale = drawn.mean(axis=0), np.maximum(drawn.std(axis=0), 1e-300)
    most = float(((agreed - centre) / scale).max())
    drawn_most = ((drawn - centre) / scale).max(axis=1)
    return float((1 + (drawn_most >= most).sum()) / (len(drawn_most) + 1))


def _bands(n_bins: int) -> list[NDArray[np.bool_]]:
    """Return which coefficients each band takes; long travels have more harmonics than circles."""
    harmonic = harmonic_numbers(n_bins)
    beyond = [(HIGHEST_HARMONIC + 1, n_bins)] if n_bins > _CIRCLE else []
    return [(harmonic >= a) & (harmonic <= b) for a, b in (*_BANDS, *beyond)]


def _gaussian_draws(
    problem: Problem, pairs: Floats, bands: Sequence[NDArray[np.bool_]], rng: np.random.Generator
) -> Floats:
    """Draw the statistic under noise that is equal round the circle: few runs allow no signs."""
    obs = problem.obs
    out = []
    for count in np.diff([*range(0, _DRAWS, _AT_A_TIME), _DRAWS]):
        drawn = rng.standard_normal((count, problem.y.size))
        drawn -= (drawn @ problem.basis) @ problem.basis.T
        rows = drawn.reshape(count, obs.n_rows, obs.n_bins).swapaxes(0, 1)
        out.append(_agreed(rows, obs.condition_of, pairs, bands))
    return np.concatenate(out)


def _agreed(rows: Floats, condition_of: Indices, pairs: Floats, bands: Sequence[NDArray[np.bool_]]) -> Floats:
    """Return what repeats agree on in each band, in units of the noise that they show themselves, shape (draws, bands).

    ``rows``, (rows, draws, n): whitened. Few repeats tell the noise of a harmonic badly, in each draw otherwise: it is
    whitened by its own.
    """
    deviation, count = within_condition(rows, condition_of)
    deviation = deviation[count > 1]
    weights = inverse_root(smoothed((deviation**2).mean(axis=0)))
    level = ((deviation * weights) ** 2).mean(axis=(0, 2))
    products = (rows * np.tensordot(pairs, rows, 1)).sum(axis=0) * weights**2
    return np.asarray(products @ np.array(bands, dtype=float).T / np.maximum(level, 1e-300)[:, None])


def _pairs(condition_of: Indices, run_of: Indices) -> Floats:
    """Return the weight of each pair of rows: same condition, different run."""
    same = condition_of[:, None] == condition_of[None, :]
    other = run_of[:, None] != run_of[None, :]
    runs = np.array([len(set(run_of[condition_of == c].tolist())) for c in range(int(condition_of.max()) + 1)])
    weight = 1.0 / np.maximum(runs - 1, 1)
    return np.asarray((same & other) * weight[condition_of][:, None])


def _foretold(problem: Problem, z: Floats) -> Floats:
    angle = from_harmonics(z)
    return np.asarray(np.einsum("nq,nqj,nqk->jk", problem.local_variance, angle, angle))


def _moderated(variance: Floats, dof: float, foretold: Floats, level: NoiseLevel) -> tuple[Floats, float]:
    """Blend the variance that the runs show with the one that the noise level foretells."""
    if level.prior_dof <= 0.0 or dof <= 0.0:
        return variance, dof
    total = dof + level.prior_dof
    return (dof * variance + level.prior_dof * level.ratio * foretold) / total, total


def _satterthwaite(power: Floats, unit: Indices, condition_of: Indices, count: Indices, lost: int) -> Floats:
    """Effective degrees of freedom of variances that differ between conditions, shape (k,).

    A run that goes there and back is in two conditions, and is one unit all the same.
    ``power``, (units, k): squares of what is summed over each unit.
    """
    first = np.full(int(unit.max()) + 1, condition_of.max())
    np.minimum.at(first, unit, condition_of)
    repeated = np.unique(unit[count > 1])
    members = np.bincount(first[repeated])
    shares = np.zeros((len(members), power.shape[1]))
    np.add.at(shares, first[repeated], power[repeated])
    shares, free = shares[members > 1], members[members > 1] - 1.0
    total, squared = shares.sum(axis=0) ** 2, (shares**2 / free[:, None]).sum(axis=0)
    dof = np.divide(total, squared, out=np.zeros_like(total), where=squared > 0.0)
    return np.maximum(dof - lost, 0.0)
