"""Figures of a recording before and after its dynamic part was taken out; fitness of a filter."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np

from dtwin.errors import InputError
from dtwin.schema import Floats
from dtwin.statistics import rms

FITNESSES = ("weighted_sum", "eq15")
ACCEPTED_DIFFERENCE = 0.1
"""Largest relative difference of circular deviation to the slow reference (eq. 14)."""


@dataclass(frozen=True)
class DynamicComponents:
    """What a filter, or a twin, took out of a recording (eqs. 6 to 8).

    Attributes:
        before_um, after_um: Circular deviation of the radial error before and after.
        dc1_um: Difference of the two.
        dc2_um: Peak to peak of what was taken out.
        dc3_um: RMS of what was taken out, as equation 8 of the source; its text says mean absolute.
    """

    before_um: float
    after_um: float
    dc1_um: float
    dc2_um: float
    dc3_um: float

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return dict(vars(self))


def dynamic_components(before_um: Floats, after_um: Floats) -> DynamicComponents:
    """Compare radial errors about their least-squares centres before and after.

    Args:
        before_um: Radial error before. Shape (n,).
        after_um: Radial error after, at the same angles. Shape (n,).

    Raises:
        InputError: When there is nothing to compare.
    """
    if before_um.shape != after_um.shape or before_um.size == 0:
        raise InputError(
            "before and after do not belong together",
            code="dynamics.shapes",
            got=f"{before_um.shape} and {after_um.shape}",
        )
    taken = before_um - after_um
    first, second = float(np.ptp(before_um)), float(np.ptp(after_um))
    return DynamicComponents(first, second, first - second, float(np.ptp(taken)), rms(taken))


def relative_difference(deviation_um: float, reference_um: float) -> float:
    """Return the relative difference of two circular deviations (eq. 14).

    Args:
        deviation_um: Circular deviation of the recording.
        reference_um: That of the slow reference.

    Raises:
        InputError: When the reference is not above zero.
    """
    if not reference_um > 0.0:
        raise InputError(
            "the reference has no circular deviation to compare with",
            code="dynamics.reference",
            got=f"{reference_um:g} µm",
            allowed="above 0",
        )
    return abs(deviation_um - reference_um) / reference_um


def eq15(dtw_um: float, frechet_um: float, difference: float) -> float:
    """Return the printed fitness: sum over Euclidean norm of the three.

    It is least, 1, when one of the three dominates however large it is, and sqrt(3) when all are
    equal however small: a perfect fit is as bad as it gets. Kept to reproduce, not to be used.

    Args:
        dtw_um: Distance by time warping.
        frechet_um: Fréchet distance.
        difference: Relative difference of circular deviation.

    Returns:
        NaN, with a warning, when all three are zero.
    """
    length = math.hypot(dtw_um, frechet_um, difference)
    if length == 0.0:
        warnings.warn(
            "the printed fitness is 0/0: the filtered curve is the reference itself", RuntimeWarning, stacklevel=2
        )
        return math.nan
    return (dtw_um + frechet_um + difference) / length


def weighted_sum(dtw_um: float, frechet_um: float, difference: float, readings: int) -> float:
    """Return a fitness in um that is zero for a perfect fit and grows with every one of the three.

    DTW per reading is an RMS, Frechet a largest distance; a relative difference beyond
    ``ACCEPTED_DIFFERENCE`` costs 1 um per hundredth.

    Args:
        dtw_um: As for :func:`eq15`.
        frechet_um: As for :func:`eq15`.
        difference: As for :func:`eq15`.
        readings: Readings per revolution.
    """
    beyond = max(0.0, difference - ACCEPTED_DIFFERENCE)
    return dtw_um / math.sqrt(readings) + frechet_um + 100.0 * beyond
