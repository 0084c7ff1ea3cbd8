"""Weights of the harmonics, from what repeats of the same condition disagree by."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from dtwin.physics.gridding import Indices
from dtwin.schema import Floats
from dtwin.statistics import f_tail

# Harmonics below have a level of their own.
SEPARATE = 5
_FLOOR = 1e-4
# Of the largest: less differs by rounding only.
_ROUNDING = 1e-20
# A zero that wanders between runs by more than their rows differ by, at this level of an F test.
_WANDERS = 0.05

CENTRE = slice(1, 3)
"""Coefficients of harmonic 1: the centre of a circle."""


def to_harmonics(values: Floats) -> Floats:
    """Return real, orthonormal Fourier coefficients along the path.

    ``values``, (rows, n, ...): values in every bin.
    Returns harmonic 0, then cosine and sine of harmonics 1, 2 ..., for an even number of bins at last harmonic n / 2:
    an orthonormal transform, so sums of squares are kept.
    """
    spectrum = np.fft.rfft(values, axis=1, norm="ortho")
    n = values.shape[1]
    paired = slice(1, (n + 1) // 2)
    out = np.empty(values.shape)
    out[:, 0] = spectrum[:, 0].real
    if n % 2 == 0:
        out[:, -1] = spectrum[:, -1].real
    end = n - 1 + n % 2
    out[:, 1:end:2] = np.sqrt(2.0) * spectrum[:, paired].real
    out[:, 2:end:2] = np.sqrt(2.0) * spectrum[:, paired].imag
    return out


def from_harmonics(coefficients: Floats) -> Floats:
    """Return values along the path from real Fourier coefficients, shape (rows, n, ...)."""
    n = coefficients.shape[1]
    shape = (len(coefficients), n // 2 + 1, *coefficients.shape[2:])
    spectrum = np.empty(shape, dtype=complex)
    spectrum[:, 0] = coefficients[:, 0]
    if n % 2 == 0:
        spectrum[:, -1] = coefficients[:, -1]
    end, paired = n - 1 + n % 2, slice(1, (n + 1) // 2)
    both = coefficients[:, 1:end:2] + 1j * coefficients[:, 2:end:2]
    spectrum[:, paired] = both / np.sqrt(2.0)
    return np.asarray(np.fft.irfft(spectrum, n, axis=1, norm="ortho"))


def harmonic_numbers(n_bins: int) -> Indices:
    """Return the harmonic that each of so many coefficients belongs to, shape (n,)."""
    return (np.arange(n_bins) + 1) // 2


@dataclass(frozen=True)
class PureError:
    """What repeats disagree by.

    ``floor_um``: RMS of one run about the mean of its condition.
    ``weights``, (n,): factors of the coefficients that make this noise white, with RMS one.
    ``variance``, (conditions,): variance of a whitened coefficient in each condition, NaN without repeats.
    ``dof``: runs minus conditions, over conditions that were repeated.
    ``zero_weight``: factor, beside its weight, of the part of coefficient 0 that all rows of a run share: below one
    where the zero of the instrument wanders from run to run by more than rows of a run differ.
    """

    floor_um: float
    weights: Floats
    variance: Floats
    dof: int
    zero_weight: float = 1.0


def zero_weighted(rows: Floats, run_of: Indices, factor: float) -> Floats:
    """Return coefficients in which what the rows of a run share of coefficient 0 is multiplied by a factor.

    ``rows``, (rows, n, ...): coefficients of harmonics.
    ``run_of``, (rows,): run of each row.
    """
    if factor == 1.0:
        return rows
    out = rows.copy()
    # A run that was left out has no rows.
    members = np.maximum(np.bincount(run_of), 1)
    shared = condition_sums(rows[:, :1], run_of)[:, 0] / members.reshape(-1, *[1] * (rows.ndim - 2))
    out[:, 0] += (factor - 1.0) * shared[run_of]
    return out


def condition_sums(rows: Floats, condition_of: Indices) -> Floats:
    """Return the sums over the rows of each condition, shape (conditions, ...)."""
    member = np.equal.outer(np.arange(int(condition_of.max()) + 1), condition_of)
    return np.asarray((member @ rows.reshape(len(rows), -1)).reshape(len(member), *rows.shape[1:]))


def within_condition(rows: Floats, condition_of: Indices) -> tuple[Floats, Indices]:
    """Return deviations from the mean of the condition, inflated to the variance of one run.

    ``rows``, (rows, ...): values of each row.
    ``condition_of``, (rows,): its condition.
    Returns ``deviations`` (rows, ...): times sqrt(m / (m - 1)); zero where nothing was repeated.
    Returns ``count`` (rows,): number of rows of the condition.
    """
    count = np.bincount(condition_of)
    mean = condition_sums(rows, condition_of)
    mean /= np.maximum(count, 1).reshape(-1, *[1] * (rows.ndim - 1))
    m = count[condition_of]
    scale = np.where(m > 1, np.sqrt(m / np.maximum(m - 1, 1)), 0.0)
    return (rows - mean[condition_of]) * scale.reshape(-1, *[1] * (rows.ndim - 1)), m


def pure_error(
    residual: Floats,
    condition_of: Indices,
    mask_share: float,
    fitted: Floats | None = None,
    run_of: Indices | None = None,
) -> PureError | None:
    """Estimate the noise from repeats.

    ``residual``, (rows, n): harmonic coefficients of the residual.
    ``condition_of``, (rows,): condition of each row.
    ``mask_share``: share of the bins that was measured.
    ``fitted``, (rows, n, k): orthonormal columns that were fitted: inside conditions they have used up degrees of
    freedom, each in the harmonics that it touches.
    ``run_of``, (rows,): run of each row, where runs have several rows in different conditions.
    Returns None with fewer than two degrees of freedom.
    """
    deviation, m = within_condition(residual, condition_of)
    repeated = m > 1
    n_conditions = len(set(condition_of[repeated].tolist()))
    full_dof = int(repeated.sum()) - n_conditions
    n_bins = residual.shape[1]
    lost = np.zeros(n_bins) if fitted is None else _used_up(fitted, condition_of)
    dof = int(full_dof - np.ceil(lost.max() - 1e-9))
    if dof < 2:
        return None
    power = (deviation[repeated] ** 2).mean(axis=0) * full_dof / (full_dof - lost)
    floor_um = float(np.sqrt(power.sum() / (n_bins * mask_share)))
    zero_weight = 1.0 if run_of is None or not repeated.all() else _zero_weight(deviation[:, 0], run_of)
    if run_of is not None:
        deviation = zero_weighted(deviation, run_of, zero_weight)
        power[0] = (deviation[repeated, 0] ** 2).mean() * full_dof / (full_dof - lost[0])
    if 2 * CENTRE.stop < n_bins and power[CENTRE].sum() < _ROUNDING * power[CENTRE.stop :].max():
        # Every row has a centre of its own: what is not there need not be white.
        power[CENTRE] = power[CENTRE.stop : 2 * CENTRE.stop].mean()
    weights = inverse_root(smoothed(power))
    white = deviation * weights
    variance = np.full(int(condition_of.max()) + 1, np.nan)
    for condition in sorted(set(condition_of[repeated].tolist())):
        variance[condition] = (white[condition_of == condition] ** 2).mean()
    return PureError(floor_um, weights, variance, dof, zero_weight)


def _zero_weight(zero: Floats, run_of: Indices) -> float:
    """Return the factor that makes what rows of a run share of their zero vary like what they do not share.

    ``zero``, (rows,): deviations from the mean of the condition.
    """
    members = np.bincount(run_of)
    shared = np.bincount(run_of, zero) / np.maximum(members, 1)
    own, runs = zero - shared[run_of], int((members > 0).sum())
    free_shared, free_own = runs - 1, len(zero) - runs - 1
    between, within = float(members @ shared**2), float(own @ own)
    if min(free_shared, free_own) < 1 or within <= 0.0:
        return 1.0
    ratio = (between / free_shared) / (within / free_own)
    return ratio**-0.5 if f_tail(ratio, (free_shared, free_own)) < _WANDERS else 1.0


def _used_up(fitted: Floats, condition_of: Indices) -> Floats:
    """Return the degrees of freedom inside conditions that columns cost, shape (n,)."""
    inside, m = within_condition(fitted, condition_of)
    share = (m - 1) / np.maximum(m, 1)
    return np.asarray(np.einsum("n,nqk->q", share, inside**2))


def inverse_root(power: Floats) -> Floats:
    """Return the weights, of RMS one, that make coefficients of this power white, shape (..., n)."""
    median, largest = np.median(power, axis=-1, keepdims=True), power.max(axis=-1, keepdims=True)
    least = np.maximum(_FLOOR * median, _ROUNDING * largest)
    # Where there is no noise at all, none is larger than another.
    weights = 1.0 / np.sqrt(np.where(least > 0.0, np.maximum(power, least), 1.0))
    return np.asarray(weights / np.sqrt(np.mean(weights**2, axis=-1, keepdims=True)))


def smoothed(power: Floats) -> Floats:
    """Average over neighbouring harmonics, shape (..., n); the lowest keep their own level."""
    harmonic = harmonic_numbers(power.shape[-1])
    first = np.searchsorted(harmonic, np.arange(harmonic[-1] + 1))
    level = np.add.reduceat(power, first, axis=-1) / np.bincount(harmonic)
    return np.asarray((level @ _neighbours(level.shape[-1]))[..., harmonic])


@cache
def _neighbours(n: int) -> Floats:
    """Return the share of each of n harmonics, the rows, in the mean about each of them, shape (n, n)."""
    out = np.eye(n)
    for h in range(SEPARATE, n):
        half = 2 if h < 12 else 6
        near = slice(max(SEPARATE, h - half), h + half + 1)
        out[:, h] = 0.0
        out[near, h] = 1.0 / len(out[near])
    return out
