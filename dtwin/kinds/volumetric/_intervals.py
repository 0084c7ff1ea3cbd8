"""How much an error changes within the time that a job takes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from dtwin.errors import InputError
from dtwin.schema import Floats


@dataclass(frozen=True)
class IntervalCurve:
    """Statistics of an error over windows of growing length.

    ``steps``, (k,): length of the windows in time steps; a window has one sample more.
    ``worst``, ``mean``, (k,): of the range inside a window.
    ``p95_spread``, (k,): 95th percentile of the standard deviation inside a window: in 95 % of the jobs of that length
    the error varies less.
    """

    steps: Floats
    worst: Floats
    mean: Floats
    p95_spread: Floats


def interval_curve(series: Floats, steps: Sequence[int]) -> IntervalCurve:
    """Return the statistics of a series over sliding windows.

    ``series``, (n,) or (n, points): an error at equal time steps; of several points the pooled windows count.
    ``steps``: lengths from 1 to n - 1: n - length windows of length + 1 samples each.
    """
    values = series.reshape(len(series), -1)
    bad = [s for s in steps if not 1 <= s <= len(values) - 1]
    if bad:
        raise InputError(
            "a window is longer than the series",
            code="volumetric.window",
            got=str(bad[0]),
            allowed=f"1 to {len(values) - 1} steps",
        )
    rows = []
    for step in steps:
        windows = sliding_window_view(values, step + 1, axis=0)
        spans = np.ptp(windows, axis=2)
        spread = np.percentile(windows.std(axis=2), 95)
        rows.append((spans.max(), spans.mean(), spread))
    worst, mean, spread_95 = np.array(rows).T
    return IntervalCurve(np.array(steps), worst, mean, spread_95)


def worse_steps(before: IntervalCurve, after: IntervalCurve) -> list[int]:
    """Return the window lengths at which a correction makes the error vary more.

    ``before``, ``after``: without and with the correction, over the same windows.
    """
    more = after.p95_spread > before.p95_spread
    return [int(s) for s in before.steps[more]]


def reduction_pct(before: float, after: float) -> float:
    """Return by how many per cent an error got smaller; NaN when there was none."""
    return 100.0 * (1.0 - after / before) if before > 0.0 else float("nan")
