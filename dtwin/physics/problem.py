"""Everything in the whitened space of harmonics: measurements, known effects, candidates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dtwin.physics.effect import Instance
from dtwin.physics.gridding import Indices
from dtwin.physics.observations import Observations
from dtwin.physics.whitening import (
    PureError,
    condition_sums,
    from_harmonics,
    pure_error,
    to_harmonics,
    within_condition,
    zero_weighted,
)
from dtwin.schema import Floats

INVISIBLE = 0.01
_LEAST_OF_A_JOINT = 1e-7
_LEAST_OF_A_TONE = 1e-6
_RANK = 1e-9
_NEIGHBOURS = 6


@dataclass(frozen=True)
class Term:
    """An effect with values of its shape parameters."""

    instance: Instance
    shape: Mapping[str, float] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """Name with axis."""
        return self.instance.label


@dataclass(frozen=True)
class Problem:
    """Measurements and known effects, whitened.

    ``y``, (rows * n,): whitened coefficients of the measurements.
    ``basis``, (rows * n, p): orthonormal basis of the set-up terms and the effects that are taken as known.
    ``noise``: what repeats disagree by; None without repeats.
    ``weights``, (n,): whitening.
    ``zero_weight``: whitening of the zero that rows of a run share, as of :class:`dtwin.physics.whitening.PureError`.
    ``parts``, (rows * n, q): columns that the basis spans: those of every set-up, then of each known effect.
    """

    obs: Observations
    y: Floats
    basis: Floats
    noise: PureError | None
    weights: Floats
    parts: tuple[Floats, ...]
    zero_weight: float = 1.0

    @cached_property
    def raw(self) -> Floats:
        """Columns that the basis spans, each of length one, shape (rows * n, q)."""
        return np.concatenate([_scaled(part) for part in self.parts], axis=1)

    @cached_property
    def residual(self) -> Floats:
        """What the known effects leave, shape (rows, n)."""
        left = self.y - self.basis @ (self.basis.T @ self.y)
        return left.reshape(self.obs.n_rows, self.obs.n_bins)

    @cached_property
    def local_variance(self) -> Floats:
        """Variance of whitened noise at every angle of every row, shape (rows, n).

        The level of the condition times a profile round the circle that all conditions share:
        noise is often larger at reversals.
        """
        noise, obs = self.noise, self.obs
        if noise is None:
            return np.ones((obs.n_rows, obs.n_bins))
        typical = float(np.nanmean(noise.variance))
        level = np.nan_to_num(noise.variance, nan=typical)[obs.condition_of]
        deviation, count = within_condition(from_harmonics(self.residual), obs.condition_of)
        # Repeats that never differ do not tell where others do.
        rows = (count > 1) & (level > 0.0)
        raw = (deviation[rows] ** 2 / level[rows][:, None]).sum(axis=0) / max(int(rows.sum()), 1)
        if not raw.any():
            return np.repeat(level[:, None], obs.n_bins, axis=1)
        kernel = np.hanning(2 * _NEIGHBOURS + 3)[1:-1]
        padded = raw.take(np.arange(-_NEIGHBOURS, len(raw) + _NEIGHBOURS), mode="wrap")
        profile = np.convolve(padded, kernel / kernel.sum(), mode="valid")
        return np.asarray(level[:, None] * profile[None, :] / profile.mean())

    def whitened(self, columns: Floats) -> Floats:
        """Return columns of shape (rows, n, k) as shape (rows * n, k)."""
        return self.weighted(to_harmonics(columns), np.arange(len(columns))).reshape(-1, columns.shape[2])

    def weighted(self, rows: Floats, of: Indices) -> Floats:
        """Return different rows of coefficients, shape (different, n, k), whitened and as all rows, shape (rows, n, k).

        ``of``, (rows,): which of them each row is.
        """
        return zero_weighted((rows * self.weights[:, None])[of], self.obs.run_of, self.zero_weight)

    def visible(self, whitened: Floats, given: Floats | None = None, least: float = INVISIBLE) -> tuple[Floats, Floats]:
        """Return the part of columns that the known effects cannot imitate.

        ``whitened``, (rows * n, k): whitened columns.
        ``given``, (rows * n, q): orthonormal columns, orthogonal to the basis, that are taken out too.
        ``least``: columns of which a smaller share is left do not count as visible.
        Returns ``left``, (rows * n, j): orthonormal columns, j <= k.
        Returns ``share``, (k,): share of each column's sum of squares that is visible.
        """
        return beside(self.basis, whitened, least, given)

    def extended(self, visible: Floats, whitened: Floats) -> Problem:
        """Return the problem with one more known effect.

        ``visible``, (rows * n, j): what ``visible`` returned for it.
        ``whitened``, (rows * n, k): its whitened columns.
        """
        return replace(self, basis=np.concatenate([self.basis, visible], axis=1), parts=(*self.parts, whitened))

    def with_known(self, parts: Sequence[Floats], least: Sequence[float]) -> Problem:
        """Return the problem with more known effects, of which columns that those before can imitate are left out.

        ``parts``, each (rows * n, k): their whitened columns.
        ``least``: share of a column that must be left, for each effect.
        """
        whole = np.concatenate(parts, axis=1)
        size = np.sqrt(squares(whole))
        left = (whole - self.basis @ (self.basis.T @ whole)) / np.where(size > 0.0, size, 1.0)
        gram = left.T @ left
        seen = np.empty(0, dtype=int)
        ends = np.cumsum([part.shape[1] for part in parts])
        for end, part, share in zip(ends, parts, least, strict=True):
            own = np.arange(end - part.shape[1], end)
            across = gram[np.ix_(own, seen)]
            inverse = np.linalg.pinv(gram[np.ix_(seen, seen)], rcond=_RANK, hermitian=True)
            rest = gram[own, own] - np.einsum("ij,jk,ik->i", across, inverse, across)
            seen = np.concatenate([seen, own[rest > share]])
        basis = np.concatenate([self.basis, orthonormal(left[:, seen])], axis=1)
        return replace(self, basis=basis, parts=(*self.parts, *parts))


def beside(basis: Floats, whitened: Floats, least: float, given: Floats | None = None) -> tuple[Floats, Floats]:
    """Return the part of columns that a basis cannot imitate, as :meth:`Problem.visible` does."""
    left = whitened - basis @ (basis.T @ whitened)
    if given is not None:
        left = left - given @ (given.T @ left)
    total = squares(whitened)
    share = np.divide(squares(left), total, out=np.zeros_like(total), where=total > 0)
    seen = share > least
    return orthonormal(left[:, seen] / np.sqrt(total[seen])), share


def squares(columns: Floats) -> Floats:
    """Return the sum of squares of each column, shape (k,)."""
    return np.asarray(np.einsum("ij,ij->j", columns, columns))


def least_visible(term: Term) -> float:
    """Return the share of a term's sum of squares that must be left beside what is known.

    An error of a joint moves the whole circle first. What is left is a thousandth of it, and
    exact, for it comes from the kinematics. Modes answer tones much alike, and tones are told to a
    thousandth.
    """
    effect = term.instance.effect
    if effect.kinds == ("sinusoidal",):
        return _LEAST_OF_A_TONE
    return _LEAST_OF_A_JOINT if effect.per == "joint" else INVISIBLE


def set_up(obs: Observations, known: Sequence[Term], within: Sequence[Term]) -> Problem:
    """Whiten a campaign.

    ``known``: effects that the twin has, without set-up terms.
    ``within``: effects that may act inside a condition: they are taken out before noise is estimated, so that what they
    do does not count as noise.
    """
    plain = unweighted(obs, known)
    noise = _noise(plain, within)
    return plain if noise is None else weighted_like(obs, known, noise)


def unweighted(obs: Observations, known: Sequence[Term]) -> Problem:
    """Return the problem with all harmonics alike: ordinary least squares.

    ``known``: effects that the twin has, without set-up terms.
    """
    flat = PureError(0.0, np.ones(obs.n_bins), np.ones(len(obs.conditions)), 0)
    return replace(weighted_like(obs, known, flat), noise=None)


def unweighted_with_noise(obs: Observations, known: Sequence[Term]) -> Problem:
    """Return the problem of ordinary least squares that knows by what repeats disagree beside what is known."""
    plain = unweighted(obs, known)
    return replace(plain, noise=_noise(plain, []))


def weighted_like(obs: Observations, known: Sequence[Term], noise: PureError) -> Problem:
    """Return the problem in a given whitening, perhaps that of another campaign.

    ``known``: effects that the twin has, without set-up terms.
    """
    columns = [setup_columns(obs)] + [obs.regressors(t.instance, t.shape) for t in known]
    y = zero_weighted(to_harmonics(obs.y_um) * noise.weights, obs.run_of, noise.zero_weight)
    empty = np.empty((obs.y_um.size, 0))
    made = Problem(obs, y.ravel(), empty, noise, noise.weights, (empty,), noise.zero_weight)
    made = replace(made, parts=(made.whitened(np.concatenate(columns, axis=2)),))
    return replace(made, basis=orthonormal(made.raw))


def setup_columns(obs: Observations) -> Floats:
    """Return what belongs to every set-up, shape (rows, n, set-up terms): on a circle its centre and radius."""
    basis = obs.grid.setup
    k = basis.shape[1]
    out = np.zeros((obs.n_rows, obs.n_bins, k * len(obs.setups)))
    for row in range(obs.n_rows):
        first = k * int(obs.setup_of[row])
        out[row, :, first : first + k] = basis
    return np.where(obs.mask[:, :, None], out, 0.0)


def orthonormal(columns: Floats) -> Floats:
    """Return an orthonormal basis of columns of shape (n, k); dependent ones are dropped."""
    if not columns.size:
        return columns
    if columns.shape[1] == 1:
        return columns / np.linalg.norm(columns)
    gram = columns.T @ columns
    values, vectors = np.linalg.eigh(gram)
    keep = values > _RANK * max(float(values[-1]), 1e-300)
    basis = columns @ (vectors[:, keep] / np.sqrt(values[keep]))
    # The second pass removes what the squared condition number cost.
    upper = np.linalg.cholesky(basis.T @ basis).T
    return np.asarray(basis @ np.linalg.inv(upper))


def _scaled(columns: Floats) -> Floats:
    size = np.sqrt(squares(columns))
    return columns[:, size > 0] / size[size > 0]


def _noise(plain: Problem, within: Sequence[Term]) -> PureError | None:
    obs = plain.obs
    share = float(obs.mask.mean())
    run_of = obs.run_of if obs.there_and_back else None
    if within:
        columns = np.concatenate([obs.regressors(t.instance, t.shape) for t in within], axis=2)
        rows = plain.whitened(columns).reshape(obs.n_rows, obs.n_bins, -1)
        # Inside conditions only: what differs between them is error, and must not leak into the noise.
        moving = _inside(rows, obs.condition_of).reshape(obs.y_um.size, -1)
        size, whole = (moving**2).sum(axis=0), (rows**2).sum(axis=(0, 1))
        moves = size > INVISIBLE * whole
        basis = orthonormal(moving[:, moves] / np.sqrt(size[moves]))
        residual = _inside(plain.residual, obs.condition_of)
        left = residual.ravel() - basis @ (basis.T @ residual.ravel())
        fitted = basis.reshape(obs.n_rows, obs.n_bins, -1)
        noise = pure_error(left.reshape(residual.shape), obs.condition_of, share, fitted, run_of)
        if noise is not None:
            return noise
    return pure_error(plain.residual, obs.condition_of, share, run_of=run_of)


def _inside(rows: Floats, condition_of: NDArray[np.int64]) -> Floats:
    """Return rows less the means of their conditions."""
    count = np.bincount(condition_of).reshape(-1, *[1] * (rows.ndim - 1))
    return np.asarray(rows - (condition_sums(rows, condition_of) / count)[condition_of])
