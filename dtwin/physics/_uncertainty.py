"""How uncertain fitted parameters are: what repeats disagree by, and what the laws miss."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dtwin.physics._score import NoiseLevel, misfit, noise_level
from dtwin.physics._shapes import possible
from dtwin.physics.candidates import probes
from dtwin.physics.problem import Problem, Term, weighted_like
from dtwin.physics.whitening import PureError, condition_sums, within_condition, zero_weighted
from dtwin.schema import Floats
from dtwin.statistics import k2_factor

# Of a parameter, the share of its information that must be left when a condition is taken out.
_SUPPORTED = 1e-6
# Conditions of a jackknife.
_FEWEST = 5
# Of logarithms of shapes: the step of their slopes.
_STEP = 1e-4


def expanded(problem: Problem, terms: Sequence[Term], columns: Floats, x: Floats) -> tuple[Floats, Floats]:
    """Return expanded uncertainties, k = 2, and the same where shapes are known to be as they were found.

    The unit of replication is the run: the spread of the scores of repeats is an estimate of the
    noise that holds whatever the noise looks like round the circle; the few degrees of freedom
    widen the interval as Student's t does (GUM, annex G). Where the laws miss more than the noise,
    runs of one condition err alike, and the unit is the condition. Shapes are in doubt, too: as far as the runs do not
    tell them, within their bounds.

    ``problem``: the campaign, not whitened by its noise.
    ``columns``, (rows * n, k): set-up terms and effects.
    ``x``, (k,): what was fitted.
    Returns (k,) each: NaN without repeats.
    """
    if problem.noise is None:
        unknown = np.full(columns.shape[1], np.nan)
        return unknown, unknown
    left = (problem.y - columns @ x).reshape(problem.obs.n_rows, problem.obs.n_bins)
    white = weighted_like(problem.obs, terms, problem.noise)
    level, misses = noise_level(white, probes(white)), misfit(white) is not None
    slopes, wide = _shape_slopes(problem, terms, x)
    at_shape = _expanded(problem, problem.noise, columns, np.empty(0), left, level, misses)
    if not len(wide):
        return at_shape, at_shape
    both = np.concatenate([columns, slopes], axis=1)
    return _expanded(problem, problem.noise, both, wide, left, level, misses)[: len(x)], at_shape


def _expanded(
    problem: Problem, noise: PureError, columns: Floats, wide: Floats, left: Floats, level: NoiseLevel, misses: bool
) -> Floats:
    """Return expanded uncertainties of the factors of columns, shape (k,).

    ``wide``, (j,): standard deviations that the last j factors have, whatever the runs tell.
    ``left``, (rows, n): what the fit leaves; ``misses``: that is more than noise.
    """
    obs = problem.obs
    size = np.sqrt((columns**2).sum(axis=0))
    scaled = columns / np.where(size > 0.0, size, 1.0)
    bound = np.zeros(len(size))
    bound[len(size) - len(wide) :] = (noise.floor_um / wide) ** 2
    bound /= np.where(size > 0.0, size, 1.0) ** 2
    inverse = np.linalg.pinv(scaled.T @ scaled + np.diag(bound), rcond=1e-10, hermitian=True)
    influence = (scaled @ inverse).reshape(obs.n_rows, obs.n_bins, -1)
    # What the bounds, and not the runs, tell of the shapes.
    untold = noise.floor_um * np.sqrt((inverse**2 * bound[:, None]).sum(axis=0))
    deviation, count = within_condition(left, obs.condition_of)
    scores = np.einsum("nqk,nq->nk", influence, deviation)
    runs = np.zeros((int(obs.run_of.max()) + 1, scores.shape[1]))
    np.add.at(runs, obs.run_of, scores)
    # Conditions without repeats add no score: scale up for them.
    share = (count > 1).sum() / obs.n_rows
    clustered = (runs**2).sum(axis=0) / share
    variance = np.nan_to_num(noise.variance, nan=float(np.nanmean(noise.variance)))
    coloured = zero_weighted(influence / noise.weights[:, None], obs.run_of, 1.0 / noise.zero_weight)
    foretold = level.ratio * np.einsum("n,nqk,nqk->k", variance[obs.condition_of], coloured, coloured)
    dof = float(noise.dof)
    blended = (dof * clustered + level.prior_dof * foretold) / (dof + level.prior_dof)
    out = k2_factor(dof + level.prior_dof) * np.sqrt(blended)
    if misses:
        out = np.maximum(out, _by_condition(problem, scaled, influence, left, bound))
    out = np.hypot(out, 2.0 * untold)
    return np.asarray(out / np.where(size > 0.0, size, np.nan))


def _shape_slopes(problem: Problem, terms: Sequence[Term], x: Floats) -> tuple[Floats, Floats]:
    """Return how what was fitted changes with the logarithm of each shape, and its standard deviation within its bounds.

    ``x``, (k,): what was fitted, set-up terms first.
    Returns (rows * n, j) and (j,).
    """
    obs = problem.obs
    slopes, wide, at = [np.empty((obs.y_um.size, 0))], [], obs.n_setup
    for term in terms:
        effect = term.instance.effect
        sizes, at = x[at : at + len(effect.parameters)], at + len(effect.parameters)
        ranges = {s.name: possible(s, sizes[0]) for s in effect.refined_shapes(obs.several_speeds)}
        ranges = {name: (low, high) for name, (low, high) in ranges.items() if low < high}
        if not ranges:
            continue
        shape = effect.start_shape | dict(term.shape)
        shape |= {name: min(max(shape[name], low), high) for name, (low, high) in ranges.items()}
        tried = [shape, *(shape | {name: shape[name] * np.exp(_STEP)} for name in ranges)]
        made = [obs.distinct_harmonics(term.instance, one, keep=False) for one in tried]
        before, *after = (problem.weighted(*one) @ sizes for one in made)
        slopes += [(moved - before).reshape(-1, 1) / _STEP for moved in after]
        wide += [np.log(high / low) / np.sqrt(12.0) for low, high in ranges.values()]
    return np.concatenate(slopes, axis=1), np.array(wide)


def _by_condition(problem: Problem, scaled: Floats, influence: Floats, left: Floats, bound: Floats) -> Floats:
    """Return expanded uncertainties with the condition as the unit, in scaled columns, shape (k,).

    Two parts: the jackknife, each condition left out once, where there are enough for one; and what
    a misfit of the observed covariance between conditions would do at harmonics at which it is not
    fitted away.
    """
    condition_of = problem.obs.condition_of
    number = int(condition_of.max()) + 1
    few = number < _FEWEST
    jackknife = 0.0 if few else _jackknife(scaled.reshape(influence.shape), left, condition_of, bound)
    means = condition_sums(left, condition_of) / np.bincount(condition_of)[:, None]
    together = means @ means.T / means.shape[1]
    summed = condition_sums(influence, condition_of)
    coherent = np.einsum("iqk,ij,jqk->k", summed, together, summed, optimize=True)
    factor = 2.0 if few else k2_factor(number - 1.0)
    return np.asarray(factor * np.sqrt(np.maximum(jackknife + coherent, 0.0)))


def _jackknife(rows: Floats, left: Floats, condition_of: NDArray[np.int64], bound: Floats) -> Floats:
    """Return the variance of what is fitted, each condition left out once, shape (k,)."""
    number = int(condition_of.max()) + 1
    grams = np.zeros((number, rows.shape[2], rows.shape[2]))
    sides = np.zeros((number, rows.shape[2]))
    for row, condition in enumerate(condition_of):
        grams[condition] += rows[row].T @ rows[row]
        sides[condition] += rows[row].T @ left[row]
    whole = grams.sum(axis=0) + np.diag(bound)
    moved = np.zeros_like(sides)
    for n in range(number):
        rest = whole - grams[n]
        supported = np.diag(rest) > _SUPPORTED * np.diag(whole)
        change = np.linalg.pinv(rest, rcond=1e-10, hermitian=True) @ (sides.sum(axis=0) - sides[n])
        moved[n, supported] = change[supported]
    return np.asarray((number - 1) / number * (moved**2).sum(axis=0))
