"""Positioning runs as if their reversal error were the same in all cycles and, of a table without a clock, their zero stood still."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dtwin.positioning._cycles import moving_zero
from dtwin.positioning._moving_reversal import moving_reversal
from dtwin.positioning.matrix import TARGET_MM, LinearTest, clock_is_assumed, in_order, linear_test
from dtwin.positioning.ways import LENGTHS, ways_of
from dtwin.schema import Run


def still(runs: Sequence[Run]) -> list[Run]:
    """Return runs of one set-up without what moves from cycle to cycle: the reversal error and, without a clock, the zero.

    A zero that moves from reading to reading (slip, lost steps, settling) belongs to no place and no direction of the axis, but makes both where cycles run
    forward first. Without a clock it cannot be fitted as a drift with time either. Runs of which neither moves are returned as they are.
    """
    ways = {ways_of(run) for run in runs}
    if len(ways) > 1 or len({run.meta.setup for run in runs}) > 1:
        return list(runs)
    test = linear_test(runs, next(iter(ways)), LENGTHS)
    if test.position_mm.size < 2:
        return list(runs)
    shifts = []
    reversal = moving_reversal(test)
    if reversal is not None:
        shifts.append(reversal.shift_um)
        test = reversal.taken_out(test)
    zero = moving_zero(test) if clock_is_assumed(runs) else None
    if zero is not None:
        shifts.append(zero.shift_um)
    if not shifts:
        return list(runs)
    cycle = {id(run): number for number, run in enumerate(in_order(runs))}
    return [_without(run, np.sum(shifts, axis=0)[:, :, cycle[id(run)]], test) for run in runs]


def _without(run: Run, shift_um: np.ndarray, test: LinearTest) -> Run:
    """Return a run without a shift (ways, targets); between targets that all runs share it is interpolated."""
    at = np.round(np.asarray(run.samples[test.scale.position], dtype=float) / TARGET_MM) * TARGET_MM
    error = np.array(run.samples[test.scale.error], dtype=float)
    for way, shift in zip(test.ways, shift_um, strict=False):
        here = np.asarray(run.samples["direction"] == way)
        error[here] -= np.interp(at[here], test.position_mm, shift)
    return replace(run, samples=dict(run.samples) | {test.scale.error: error})
