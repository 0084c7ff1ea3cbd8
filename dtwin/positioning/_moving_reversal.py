"""What the reversal error of a positioning test does from cycle to cycle."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dtwin.positioning._cycles import ORDINARY
from dtwin.positioning._spoilt import spoilt_readings
from dtwin.positioning.matrix import LinearTest
from dtwin.positioning.ways import BOTH
from dtwin.schema import Finding, Floats
from dtwin.statistics import f_tail
from dtwin.units import shown_number

_FEWEST_CYCLES = 3
_STRETCHES = 5
"""Parts of the travel whose means tell by what the reversal error of a cycle is uncertain; air moves neighbouring readings alike."""
_CHANCE = 1e-3
"""How often cycles that only scatter may differ so (F test)."""


@dataclass(frozen=True)
class _MovingReversal:
    """How the reversal error moves from cycle to cycle.

    ``shift_um`` (ways, targets, cycles): what readings are off by from those with the mean reversal error.
    """

    finding: Finding
    shift_um: Floats

    def taken_out(self, test: LinearTest) -> LinearTest:
        """Return the test with the same reversal error in all cycles."""
        forward, reverse = self.shift_um
        return replace(test, forward_um=test.forward_um - forward, reverse_um=test.reverse_um - reverse)


def moving_reversal(test: LinearTest) -> _MovingReversal | None:
    """Return how the reversal error moves from cycle to cycle; None when it does not, or not by more than is ordinary.

    Looked at is the reversal error where a cycle turns round, so that a zero that moves from sweep to sweep is none of it. What grows or
    shrinks in every cycle does so steadily, within cycles too; what comes and goes is alike within a cycle.
    """
    targets, cycles = test.forward_um.shape
    if test.ways != BOTH or cycles < _FEWEST_CYCLES or targets < 2 * _STRETCHES:
        return None
    reversal = test.forward_um - test.reverse_um
    for spoilt in spoilt_readings(test):
        reversal[spoilt.target, spoilt.cycle] = np.nan
    turned = _turned(reversal, test.first)
    if turned is None:
        return None
    size = np.nanmean(reversal) + turned
    steps = np.diff(np.abs(size))
    steady = bool(np.all(np.sign(size) == np.sign(size[0])) and (np.all(steps > 0.0) or np.all(steps < 0.0)))
    share = (np.arange(targets) + 0.5) / (2 * targets)
    within = np.stack([0.5 + share, 0.5 - share] if test.first == "reverse" else [share, 1.0 - share])[:, :, None]
    times = within + np.arange(float(cycles))
    off = _along(times, turned) if steady else np.broadcast_to(turned, times.shape)
    return _MovingReversal(_finding(test, size, steady), np.array([0.5, -0.5])[:, None, None] * off)


def _turned(reversal: Floats, first: str) -> Floats | None:
    """Return by what the reversal error of each cycle, where it turns round, is off from their mean, shape (cycles,).

    ``reversal`` (targets, cycles). None where it is off by no more than chance, or than is ordinary, or too many readings are spoilt.
    """
    cycles = reversal.shape[1]
    off = reversal - np.nanmean(reversal, axis=1, keepdims=True)
    parts = np.array_split(off, _STRETCHES)
    if any(np.isnan(part).all(axis=0).any() for part in parts):
        return None
    means = np.stack([np.nanmean(part, axis=0) for part in parts])
    # A zero that moves between both readings of a target shows in proportion to the time between them.
    apart = (np.arange(_STRETCHES) + 0.5) / _STRETCHES
    apart = apart if first == "reverse" else 1.0 - apart
    design = np.stack([np.ones(_STRETCHES), apart], axis=1)
    solution, *_ = np.linalg.lstsq(design, means, rcond=None)
    turned = solution[0] - solution[0].mean()
    dof = (_STRETCHES - 2) * (cycles - 1)
    variance = float(((means - design @ solution) ** 2).sum()) / dof * float(np.linalg.inv(design.T @ design)[0, 0])
    ratio = float((turned**2).sum()) / (cycles - 1) / max(variance, 1e-12)
    little = not np.isfinite(ratio) or np.ptp(turned) < ORDINARY
    return None if little or f_tail(ratio, (cycles - 1, dof)) > _CHANCE else np.asarray(turned)


def _along(times: Floats, turned: Floats) -> Floats:
    """Return what is given in the middle of each cycle at other times, in cycles: on straight lines, beyond the ends too."""
    middles = np.arange(len(turned)) + 0.5
    out = np.interp(times, middles, turned)
    for end, beside in ((0, 1), (-1, -2)):
        slope = (turned[end] - turned[beside]) / (middles[end] - middles[beside])
        beyond = times < middles[0] if end == 0 else times > middles[-1]
        out = np.where(beyond, turned[end] + slope * (times - middles[end]), out)
    return np.asarray(out)


def _finding(test: LinearTest, size: Floats, steady: bool) -> Finding:
    fine = test.scale.fine
    first, last = (shown_number(abs(float(value)), 2) for value in (size[0], size[-1]))
    low, high = (shown_number(float(value), 2) for value in (size.min(), size.max()))
    moves = f"the reversal error lies between {low} and {high} {fine}"
    if steady:
        between = f"{first} {fine} in cycle {test.cycle(0)} to {last} {fine} in cycle {test.cycle(len(size) - 1)}"
        larger = abs(size[-1]) > abs(size[0])
        moves = f"the reversal error grows from {between}" if larger else f"the reversal error shrinks from {between}"
    said = (
        f"cycles differ: {moves}; B and a backlash are the mean of the cycles. Nut, coupling or bearing come loose, "
        "or preload changes as the drive warms up: tighten them, warm up and measure again"
    )
    return Finding(
        f"{test.scale.kind}.reversal_moves",
        "warning",
        said,
        {f"first_{test.scale.figure}": float(size[0]), f"last_{test.scale.figure}": float(size[-1])},
    )
