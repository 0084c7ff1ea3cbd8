"""Figures of a linear positioning test, ISO 230-2."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dtwin.errors import InputError
from dtwin.schema import Floats


@dataclass(frozen=True)
class LinearFigures:
    """Figures of a bidirectional test of one axis, in um.

    Attributes
    ----------
    accuracy_um : float
        A, bidirectional accuracy of positioning.
    accuracy_forward_um, accuracy_backward_um : float
        Unidirectional accuracy.
    repeatability_um : float
        R, bidirectional repeatability.
    repeatability_forward_um, repeatability_backward_um : float
        Unidirectional repeatability, 4 s.
    reversal_um, mean_reversal_um : float
        B, the largest reversal error, and its mean over the axis.
    systematic_um : float
        E, bidirectional systematic deviation.
    systematic_forward_um, systematic_backward_um : float
        Unidirectional systematic deviation.
    mean_deviation_um : float
        M, range of the mean bidirectional deviation.
    """

    accuracy_um: float
    accuracy_forward_um: float
    accuracy_backward_um: float
    repeatability_um: float
    repeatability_forward_um: float
    repeatability_backward_um: float
    reversal_um: float
    mean_reversal_um: float
    systematic_um: float
    systematic_forward_um: float
    systematic_backward_um: float
    mean_deviation_um: float


def linear_figures(forward_um: Floats, backward_um: Floats) -> LinearFigures:
    """Evaluate a bidirectional positioning test.

    Parameters
    ----------
    forward_um, backward_um : ndarray, shape (positions, runs)
        Deviation at every target position in every run, approached from below and from above.

    Returns
    -------
    LinearFigures

    Raises
    ------
    InputError
        With fewer than two runs, other shapes for the two directions, or missing values.

    Notes
    -----
    Coverage factor 2, as in the standard: an interval is the mean plus or minus twice the
    standard deviation of the runs at that position.
    """
    forward, backward = np.asarray(forward_um, float), np.asarray(backward_um, float)
    if forward.ndim != 2 or forward.shape != backward.shape or forward.shape[1] < 2:
        raise InputError(
            "a positioning test needs the same targets in both directions, at least twice",
            code="linear.runs",
            got=f"{forward.shape} forward, {backward.shape} backward",
            allowed="two arrays of shape (positions, runs), runs >= 2; the standard asks for five",
        )
    if not (np.isfinite(forward).all() and np.isfinite(backward).all()):
        raise InputError(
            "a positioning test has missing values",
            code="linear.not_finite",
            got=f"{int((~np.isfinite(forward)).sum() + (~np.isfinite(backward)).sum())} values",
        )
    up, down = forward.mean(axis=1), backward.mean(axis=1)
    s_up, s_down = forward.std(axis=1, ddof=1), backward.std(axis=1, ddof=1)
    reversal = up - down
    both = np.maximum.reduce([2 * s_up + 2 * s_down + np.abs(reversal), 4 * s_up, 4 * s_down])
    highest, lowest = (np.maximum(up + 2 * s_up, down + 2 * s_down), np.minimum(up - 2 * s_up, down - 2 * s_down))
    return LinearFigures(
        accuracy_um=float(highest.max() - lowest.min()),
        accuracy_forward_um=float((up + 2 * s_up).max() - (up - 2 * s_up).min()),
        accuracy_backward_um=float((down + 2 * s_down).max() - (down - 2 * s_down).min()),
        repeatability_um=float(both.max()),
        repeatability_forward_um=float(4 * s_up.max()),
        repeatability_backward_um=float(4 * s_down.max()),
        reversal_um=float(np.abs(reversal).max()),
        mean_reversal_um=float(reversal.mean()),
        systematic_um=float(max(up.max(), down.max()) - min(up.min(), down.min())),
        systematic_forward_um=float(np.ptp(up)),
        systematic_backward_um=float(np.ptp(down)),
        mean_deviation_um=float(np.ptp((up + down) / 2)),
    )
