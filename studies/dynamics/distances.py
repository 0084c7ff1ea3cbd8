"""How far two curves are apart: dynamic time warping and the discrete Frechet distance.

Both are the same recurrence over the table of pairs, with a sum in one and a maximum in the
other, and both are wanted of the same pair of curves thousands of times: one kernel fills both.
"""

from __future__ import annotations

import numpy as np

from dtwin.errors import InputError
from dtwin.features.compiled import compiled
from dtwin.schema import Floats
from studies.dynamics.turns import MOST_READINGS


@compiled
def warped_kernel(first: Floats, second: Floats) -> tuple[float, float]:
    """Return squared DTW cost and squared discrete Frechet distance, shapes (n,) and (m,)."""
    m = second.shape[0]
    total, bottleneck = np.empty(m), np.empty(m)
    for i in range(first.shape[0]):
        diagonal_total, diagonal_neck = 0.0, 0.0
        for j in range(m):
            cost = (first[i] - second[j]) ** 2
            before_total, before_neck = diagonal_total, diagonal_neck
            if i > 0:
                diagonal_total, diagonal_neck = total[j], bottleneck[j]
                if j == 0 or total[j] < before_total:
                    before_total = total[j]
                if j == 0 or bottleneck[j] < before_neck:
                    before_neck = bottleneck[j]
            if j > 0:
                if i == 0 or total[j - 1] < before_total:
                    before_total = total[j - 1]
                if i == 0 or bottleneck[j - 1] < before_neck:
                    before_neck = bottleneck[j - 1]
            total[j] = cost + before_total
            bottleneck[j] = max(cost, before_neck)
    return total[m - 1], bottleneck[m - 1]


def distances_um(first_um: Floats, second_um: Floats) -> tuple[float, float]:
    """Return the dynamic-time-warping distance and the discrete Frechet distance (Eiter and Mannila 1994).

    The first is the root of the sum of squares along the path.

    Args:
        first_um: Curve. Shape (n,).
        second_um: Curve. Shape (m,).

    Raises:
        InputError: When a curve is empty, not finite or longer than ``MOST_READINGS``.
    """
    curves = [np.ascontiguousarray(c, dtype=np.float64) for c in (first_um, second_um)]
    for curve in curves:
        if not 0 < curve.size <= MOST_READINGS or not np.isfinite(curve).all():
            raise InputError(
                "a curve cannot be compared",
                code="dynamics.curve",
                got=f"{curve.size} readings, {int((~np.isfinite(curve)).sum())} of them not finite",
                allowed=f"1 to {MOST_READINGS} finite readings; the cost grows with the square",
                hint="resample it by angle first",
            )
    total, bottleneck = warped_kernel(*curves)
    return float(np.sqrt(total)), float(np.sqrt(bottleneck))
