"""Figures of a linear positioning test, ISO 230-2."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dtwin.errors import InputError
from dtwin.schema import Floats


@dataclass(frozen=True)
class LinearFigures:
    """Figures of a bidirectional test of one axis, in um.

    Attributes:
        accuracy_um: A, bidirectional accuracy of positioning.
        accuracy_forward_um, accuracy_backward_um: Unidirectional accuracy.
        repeatability_um: R, bidirectional repeatability.
        repeatability_forward_um, repeatability_backward_um: Unidirectional repeatability, 4 s.
        reversal_um, mean_reversal_um: B, the largest reversal error, and its mean over the axis.
        systematic_um: E, bidirectional systematic deviation.
        systematic_forward_um, systematic_backward_um: Unidirectional systematic deviation.
        mean_deviation_um: M, range of the mean bidirectional deviation.
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

    Args:
        forward_um: Deviation at every target position in every run, approached from below. Shape (positions, runs).
        backward_um: The same, approached from above.

    Returns:
        LinearFigures

    Raises:
        InputError: With fewer than two runs, other shapes for the two directions, or missing values.

    Note:
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
    return LinearFigures(**{name: float(value) for name, value in stacked_figures(forward, backward).items()})


def stacked_figures(forward_um: Floats, backward_um: Floats) -> dict[str, Floats]:
    """Return the figures of many tests at once by name, in um, each of shape (...).

    Args:
        forward_um: Deviation at every target position in every run, approached from below. Shape (positions, runs).
        backward_um: The same, approached from above.
    """
    up, down = forward_um.mean(axis=-1), backward_um.mean(axis=-1)
    s_up, s_down = forward_um.std(axis=-1, ddof=1), backward_um.std(axis=-1, ddof=1)
    reversal = up - down
    both = np.maximum.reduce([2 * s_up + 2 * s_down + np.abs(reversal), 4 * s_up, 4 * s_down])
    tops, bottoms = (up + 2 * s_up, down + 2 * s_down), (up - 2 * s_up, down - 2 * s_down)
    return {
        "accuracy_um": np.maximum(*tops).max(axis=-1) - np.minimum(*bottoms).min(axis=-1),
        "accuracy_forward_um": tops[0].max(axis=-1) - bottoms[0].min(axis=-1),
        "accuracy_backward_um": tops[1].max(axis=-1) - bottoms[1].min(axis=-1),
        "repeatability_um": both.max(axis=-1),
        "repeatability_forward_um": 4 * s_up.max(axis=-1),
        "repeatability_backward_um": 4 * s_down.max(axis=-1),
        "reversal_um": np.abs(reversal).max(axis=-1),
        "mean_reversal_um": reversal.mean(axis=-1),
        "systematic_um": np.maximum(up, down).max(axis=-1) - np.minimum(up, down).min(axis=-1),
        "systematic_forward_um": np.ptp(up, axis=-1),
        "systematic_backward_um": np.ptp(down, axis=-1),
        "mean_deviation_um": np.ptp((up + down) / 2, axis=-1),
    }
