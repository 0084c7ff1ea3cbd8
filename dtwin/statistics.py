"""Size, quantiles, tails and many tests at once; importing ``scipy.stats`` would take a second of every command.

``dof`` are degrees of freedom, of F those of numerator and denominator; probabilities are between 0 and 1.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from dtwin.schema import Floats

_K2 = 0.97725
"""Share of a normal distribution below two standard deviations."""


def rms(values: ArrayLike) -> float:
    """Return the root of the mean square, in the unit of the values; NaN of none."""
    return float(np.sqrt(np.mean(np.square(values)))) if np.size(values) else float("nan")


def usual_size(off: ArrayLike) -> float:
    """Return the standard deviation of normal values from the median of their distances, which a few wild ones do not move."""
    return 1.4826 * float(np.median(np.abs(off)))


def gain_tail(before: Floats, after: Floats) -> float:
    """Return the one-sided p-value of a gain over blocks, of the logarithm: no single block decides.

    ``before``, ``after``: what is left in each block, at least zero, shape (n,).
    """
    gain = np.log(np.maximum(before, 1e-12) / np.maximum(after, 1e-12))
    spread = float(gain.std(ddof=1)) / np.sqrt(len(gain))
    return t_tail(float(gain.mean()) / spread, len(gain) - 1.0) if spread > 0.0 else 1.0


def t_quantile(probability: float, dof: float) -> float:
    """Return where Student's t has this probability below it."""
    return float(special.stdtrit(dof, probability))


def k2_factor(dof: float) -> float:
    """Return the factor of Student's t that covers what k = 2 covers of a normal distribution."""
    return t_quantile(_K2, dof)


def t_tail(t: float, dof: float) -> float:
    """Return the probability that Student's t lies above a value."""
    return float(special.stdtr(dof, -t))


def f_quantile(tail: float, dof: tuple[float, float]) -> float:
    """Return the value of F above which this probability lies."""
    return float(special.fdtri(*dof, 1.0 - tail))


def f_tail(f: float, dof: tuple[float, float], noncentrality: float = 0.0) -> float:
    """Return the probability that F lies above a value; below zero everything lies above it.

    ``noncentrality``: of an effect that is there; 0 under the null hypothesis.
    """
    if noncentrality > 0.0:
        return float(1.0 - special.ncfdtr(*dof, noncentrality, max(f, 0.0)))
    return float(special.fdtrc(*dof, max(f, 0.0)))


def chi2_tail(chi2: float, dof: float) -> float:
    """Return the probability that chi-squared lies above a value, which is at least 0."""
    return float(special.chdtrc(dof, chi2))


def chi2_quantile(probability: float, dof: float) -> float:
    """Return where chi-squared has this probability below it."""
    return float(2.0 * special.gammaincinv(dof / 2.0, probability))


def deviation_interval(deviation: float, dof: float) -> tuple[float, float]:
    """Return the 95 % interval of a standard deviation that was estimated from normal values, by chi-squared.

    ``dof``: those of the estimate, above 0.
    """
    low, high = (deviation * np.sqrt(dof / special.chdtri(dof, tail)) for tail in (0.025, 0.975))
    return float(low), float(high)


def holm(p_values: ArrayLike, tests: float | None = None) -> Floats:
    """Return p-values after Holm's correction for many tests: no smaller than before, none above 1, in the same order.

    ``p_values``: of the single tests, shape (n,).
    ``tests``: how many of them are independent; all without.
    """
    p = np.asarray(p_values, dtype=np.float64)
    order = np.argsort(p, kind="stable")
    share = 1.0 if tests is None else tests / max(len(p), 1)
    counted = np.maximum(1.0, share * np.arange(len(p), 0, -1))
    adjusted = np.empty(len(p))
    adjusted[order] = np.maximum.accumulate(np.minimum(p[order] * counted, 1.0))
    return adjusted


def shared_variances(variance: Floats, dof: Floats, usual: float) -> tuple[Floats, Floats]:
    """Return variances of groups as far as they surely differ, and the weight of each group's own beside the usual one.

    By how much more than chance the variances differ tells the weight (empirical Bayes): none where they differ by chance.

    ``variance``, ``dof``: of each group, shape (n,); a group of no degrees of freedom tells nothing.
    ``usual``: variance of all groups.
    """
    told = dof > 0.0
    ratio = np.where(told, variance / usual, 1.0) if usual > 0.0 else np.ones(len(dof))
    chance = 2.0 / np.maximum(dof, 1.0)
    differ = max(0.0, float(np.mean(((ratio - 1.0) ** 2 - chance)[told]))) if told.any() else 0.0
    weight = np.where(told, differ / (differ + (1.0 + differ) * chance), 0.0)
    return np.asarray(usual * (1.0 + weight * (ratio - 1.0))), weight


def times_simulated(numbers: int) -> int:
    """Return how often a test of so many numbers is simulated: a thousand times, a long one less often."""
    return max(200, min(1000, 5_000_000 // max(numbers, 1)))
