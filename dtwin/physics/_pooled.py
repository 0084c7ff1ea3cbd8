"""Least squares over several campaigns at once: each with its columns, weight and noise, some parameters common."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dtwin.physics._score import NoiseLevel, misfit, noise_level
from dtwin.physics._solve import Solution, in_blocks, solve_blocks
from dtwin.physics.candidates import probes
from dtwin.physics.fit import shaped
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Problem, Term, setup_columns, weighted_like
from dtwin.physics.whitening import condition_sums, within_condition, zero_weighted
from dtwin.schema import Floats
from dtwin.statistics import k2_factor

# Conditions of a jackknife.
_FEWEST = 5
_RANK = 1e-10
# A combination of parameters of which a smaller share is left beside the others is not determined.
_DETERMINED = 1e-6


@dataclass(frozen=True)
class Part:
    """A campaign in a common fit.

    ``problem``: not whitened, with what its repeats disagree by.
    ``terms``: effects as this campaign sees them.
    ``number_of``: which term of the machine each of them is.
    ``columns``, (rows * n, k): set-up terms, then effects.
    ``row_weight``, (rows,): of each row within the campaign; 1 in a fit that is not robust.
    ``weight``: of the campaign, 1/um: one by what is left within its runs, less where it knows less than so many independent readings.
    """

    problem: Problem
    terms: tuple[Term, ...]
    number_of: tuple[int, ...]
    columns: Floats
    row_weight: Floats
    weight: float

    @property
    def obs(self) -> Observations:
        """Its runs."""
        return self.problem.obs

    @cached_property
    def root(self) -> Floats:
        """Factor of every whitened coefficient, shape (rows * n, 1)."""
        return (self.weight * np.repeat(np.sqrt(self.row_weight), self.obs.n_bins))[:, None]

    @cached_property
    def gram(self) -> Floats:
        """Normal matrix in its own columns, shape (k, k)."""
        weighted = self.columns * self.root
        return np.asarray(weighted.T @ weighted)

    @cached_property
    def side(self) -> Floats:
        """Right side of its normal equations, shape (k,)."""
        return np.asarray((self.columns * self.root**2).T @ self.problem.y)

    @cached_property
    def noise_level(self) -> tuple[NoiseLevel, bool]:
        """How far its noise is alike along the path, and whether the laws of its effects miss more than that."""
        assert self.problem.noise is not None
        white = weighted_like(self.obs, self.terms, self.problem.noise)
        return noise_level(white, probes(white)), misfit(white) is not None

    @cached_property
    def shaped_alone(self) -> list[Term]:
        """Its effects, shaped as by itself."""
        return shaped(self.obs, self.terms)

    def spans(self) -> Iterator[tuple[int, slice]]:
        """Yield number within ``terms`` and columns of every effect."""
        first = self.obs.n_setup
        for i, term in enumerate(self.terms):
            k = len(term.instance.effect.parameters)
            yield i, slice(first, first + k)
            first += k


def own_columns(problem: Problem, terms: Sequence[Term]) -> Floats:
    """Return set-up columns and effects of a campaign, in their units, shape (rows * n, k)."""
    parts = [setup_columns(problem.obs), *(problem.obs.regressors(t.instance, t.shape) for t in terms)]
    return problem.whitened(np.concatenate(parts, axis=2))


def solve_pooled(parts: Sequence[Part], maps: Sequence[Floats]) -> Solution:
    """Solve all campaigns together.

    ``maps``, (k_i, total): which common parameters make each own one.
    """

    def blocks() -> Iterator[tuple[Floats, Floats]]:
        for part, to_own in zip(parts, maps, strict=True):
            weighted, y = part.columns * part.root, part.problem.y * part.root[:, 0]
            for columns, right in in_blocks(weighted, y):
                yield columns @ to_own, right

    return solve_blocks(blocks())


def normal_inverse(parts: Sequence[Part], maps: Sequence[Floats]) -> Floats:
    """Return the pseudo-inverse of the common normal matrix, shape (total, total)."""
    normal = sum(m.T @ p.gram @ m for p, m in zip(parts, maps, strict=True))
    return _inverse(np.asarray(normal))


def determined(parts: Sequence[Part], maps: Sequence[Floats]) -> NDArray[np.bool_]:
    """Tell which columns, taken in their order, say something that those before do not, shape (total,)."""
    normal = np.asarray(sum(m.T @ p.gram @ m for p, m in zip(parts, maps, strict=True)))
    size = np.sqrt(np.diag(normal))
    scaled = normal / np.outer(np.where(size > 0.0, size, 1.0), np.where(size > 0.0, size, 1.0))
    kept: list[int] = []
    for i in range(len(scaled)):
        before = scaled[np.ix_(kept, kept)]
        across = scaled[kept, i]
        left = scaled[i, i] - across @ np.linalg.pinv(before, rcond=_RANK, hermitian=True) @ across if kept else 1.0
        if size[i] > 0.0 and left > _DETERMINED:
            kept.append(i)
    out = np.zeros(len(scaled), dtype=bool)
    out[kept] = True
    return out


@dataclass(frozen=True)
class _Spread:
    """Standard uncertainty of what was fitted, with its degrees of freedom; shape (total,) each."""

    standard: Floats
    dof: Floats

    @property
    def expanded(self) -> Floats:
        """Expanded uncertainties, k = 2, widened by few degrees of freedom; NaN where nothing was repeated."""
        factors = [k2_factor(d) if np.isfinite(d) else np.nan for d in self.dof]
        return np.asarray(self.standard * np.array(factors))


def spread(parts: Sequence[Part], maps: Sequence[Floats], x: Floats, inverse: Floats) -> _Spread:
    """Return how uncertain a common fit is: every campaign adds what its own runs scatter by.

    The unit of replication is the run; where the laws miss more than the noise, it is the condition. Degrees of freedom of
    the sum after Welch and Satterthwaite.
    """
    each = [_of_part(part, to_own, x, inverse) for part, to_own in zip(parts, maps, strict=True)]
    variance = np.sum([v for v, _ in each], axis=0)
    least = np.sum([v**2 / d for v, d in each], axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        dof = np.where(least > 0.0, variance**2 / least, np.nan)
    return _Spread(np.sqrt(variance), np.asarray(dof))


def wider(part: Part, x: Floats, of: NDArray[np.bool_]) -> float:
    """Return how many times less certain parameters of a campaign are, fitted alone, than its weight says: the median.

    Neighbours along a path scatter together, and all of a run: so many readings tell less than as many independent ones.

    ``x``, (k,): its own parameters; ``of``, (k,): those that count.
    """
    if part.problem.noise is None:
        return 1.0
    inverse = _inverse(part.gram)
    own = of & (np.diag(inverse) > 0.0)
    if not own.any():
        return 1.0
    variance, _ = _of_part(part, np.eye(len(x)), x, inverse)
    times = float(np.sqrt(np.median(variance[own] / np.diag(inverse)[own])))
    return max(times, 1.0) if np.isfinite(times) else 1.0


@dataclass(frozen=True)
class _Scatter:
    """What the runs of a campaign scatter by, and what that does to the common parameters.

    ``influence``, (rows, n, total): of each whitened reading; ``left``, (rows, n): what the fit leaves.
    ``covariance``, (total, total), ``dof``: with the run as the unit.
    ``misses``: whether the laws miss more than the noise.
    """

    influence: Floats
    left: Floats
    covariance: Floats
    dof: float
    misses: bool


def scatter(part: Part, to_own: Floats, x: Floats, inverse: Floats) -> _Scatter:
    """Return what a campaign adds to the covariance of the common parameters by what its runs scatter by."""
    obs, noise = part.obs, part.problem.noise
    influence = ((part.columns * part.root**2) @ (to_own @ inverse)).reshape(obs.n_rows, obs.n_bins, -1)
    left = (part.problem.y - part.columns @ (to_own @ x)).reshape(obs.n_rows, obs.n_bins)
    if noise is None:
        # Nothing was repeated: what is left counts as noise of whole runs.
        runs = _by_run(obs, np.einsum("nqk,nq->nk", influence, left))
        return _Scatter(influence, left, np.asarray(runs.T @ runs), float(max(len(runs) - 1, 1)), False)
    deviation, count = within_condition(left, obs.condition_of)
    runs = _by_run(obs, np.einsum("nqk,nq->nk", influence, deviation))
    clustered = runs.T @ runs * obs.n_rows / (count > 1).sum()
    level, misses = part.noise_level
    of_condition = np.nan_to_num(noise.variance, nan=float(np.nanmean(noise.variance)))
    coloured = zero_weighted(influence / noise.weights[:, None], obs.run_of, 1.0 / noise.zero_weight)
    coloured = (coloured * np.sqrt(of_condition[obs.condition_of])[:, None, None]).reshape(-1, coloured.shape[2])
    dof = float(noise.dof) + level.prior_dof
    covariance = (noise.dof * clustered + level.prior_dof * level.ratio * coloured.T @ coloured) / dof
    return _Scatter(influence, left, np.asarray(covariance), dof, bool(misses))


def missed(part: Part, seen: _Scatter) -> Floats:
    """Return what the means of conditions miss, alike along the path, shape (total, total); the condition is the unit."""
    obs = part.obs
    means = condition_sums(seen.left, obs.condition_of) / np.bincount(obs.condition_of)[:, None]
    summed = condition_sums(seen.influence, obs.condition_of)
    together = means @ means.T / means.shape[1]
    return np.asarray(np.einsum("iqk,ij,jql->kl", summed, together, summed, optimize=True))


def _of_part(part: Part, to_own: Floats, x: Floats, inverse: Floats) -> tuple[Floats, float]:
    """Return what a campaign adds to the variance of the common parameters, shape (total,), and its degrees of freedom."""
    seen = scatter(part, to_own, x, inverse)
    variance = np.diag(seen.covariance)
    if seen.misses:
        number = len(part.obs.conditions)
        # The degrees of freedom of conditions are taken where they make the interval wider.
        factor = (k2_factor(float(number - 1)) if number >= _FEWEST else 2.0) / k2_factor(seen.dof)
        variance = np.maximum(variance, _by_condition(part, seen) * factor**2)
    return variance, seen.dof


def _by_run(obs: Observations, scores: Floats) -> Floats:
    """Return the sums of scores of rows (n, k) over runs, shape (runs, k)."""
    runs = np.zeros((int(obs.run_of.max()) + 1, scores.shape[1]))
    np.add.at(runs, obs.run_of, scores)
    return runs


def _by_condition(part: Part, seen: _Scatter) -> Floats:
    """Return the variance with the condition as the unit: what the mean of each misses, and what it scatters by."""
    coherent, number = np.diag(missed(part, seen)), len(part.obs.conditions)
    if number < _FEWEST:
        return np.asarray(coherent)
    scores = condition_sums(np.einsum("nqk,nq->nk", seen.influence, seen.left), part.obs.condition_of)
    return np.asarray(coherent + number / (number - 1) * (scores**2).sum(axis=0))


def _inverse(normal: Floats) -> Floats:
    size = np.sqrt(np.diag(normal))
    scale = np.where(size > 0.0, size, 1.0)
    scaled = normal / np.outer(scale, scale)
    return np.asarray(np.linalg.pinv(scaled, rcond=_RANK, hermitian=True) / np.outer(scale, scale))
