"""A figure over the tests of a machine: has it changed, when, how does it go on.

The chart is self-starting: each value is compared with the mean and the deviation of those before it, which gives
independent standard normal numbers while nothing changes, however few tests there are (D. M. Hawkins, Self-starting CUSUM
charts for location and scale, 1987). On these numbers a limit for single values, an EWMA and a CUSUM watch, each with a
stated mean run length without a change, which integral equations give (S. V. Crowder 1987; D. Brook and D. A. Evans 1972).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import special

from dtwin.schema import Floats
from dtwin.statistics import t_quantile

_WEIGHT = 0.2
"""Of the newest value in the EWMA."""
_SLACK = 0.5
"""Of the CUSUM, in standard deviations: half of the step that it sees best."""
_NODES = 60
_COVERED = 0.975
_FEWEST = 4
"""Tests that a line needs."""
_STRICT = 1.5
"""Of Schwarz's criterion, for the variance is estimated from few tests; chosen among 1 to 3 on simulated steps and slopes."""


@dataclass(frozen=True)
class Regime:
    """Tests in a row between two changes.

    ``first``, ``last``: of its tests.
    ``why``: ``start``, ``alarm`` or ``restart``: what began it.
    ``mean``, ``expanded``: of its values, half width that covers 95 %; NaN of a single one.
    ``floor``: noise floor of tests: half width about level or line in which another test lies with 95 % while nothing
        changes; NaN of fewer than three tests.
    ``slope``, ``slope_expanded``: per day; NaN of fewer than four tests, or of one day.
    ``ends``: values of that line at the first and the last test; NaN without a slope.
    ``trend``: whether a line, not a level, describes it, so that its change is the slope.
    """

    first: int
    last: int
    why: str
    mean: float
    expanded: float
    floor: float
    slope: float
    slope_expanded: float
    ends: tuple[float, float]
    trend: bool


@dataclass(frozen=True)
class _Alarm:
    """The chart left its limits.

    ``at``: the test that raised it.
    ``first``: the first test after the change, of a trend the first one of its regime.
    ``step``, ``expanded``: level after minus level before, half width that covers 95 %; NaN of a trend.
    """

    at: int
    first: int
    trend: bool
    step: float
    expanded: float


@dataclass(frozen=True)
class _ChartLimits:
    """Of single values, of the EWMA and of the CUSUM, in standard deviations of the values."""

    single: float
    ewma: float
    cusum: float


@dataclass(frozen=True)
class Chart:
    """A chart of n values.

    ``single``, ``ewma``, ``cusum_up``, ``cusum_down``, shape (n,): in standard deviations; zero where a regime is too
    young to compare with.
    ``limits``: an alarm is beyond any of them.
    """

    single: Floats
    ewma: Floats
    cusum_up: Floats
    cusum_down: Floats
    limits: _ChartLimits
    regimes: tuple[Regime, ...]
    alarms: tuple[_Alarm, ...]


def chart(days: Floats, values: Floats, restarts: Sequence[int], run_length: float) -> Chart:
    """Watch the values of a figure.

    ``days``, ``values``, shape (n,): in the order of time.
    ``restarts``: tests before which something is known to have changed: what came before is not compared with.
    ``run_length``: mean number of tests between two false alarms.
    """
    n = len(values)
    limits = _limits_for(run_length)
    shown = np.zeros((4, n))
    starts = sorted({0, *(r for r in restarts if 0 < r < n)})
    regimes: list[Regime] = []
    alarms: list[_Alarm] = []
    for start, stop in zip(starts, [*starts[1:], n], strict=True):
        why = "restart" if start else "start"
        while start < stop:
            shown[:, start:stop] = _watched(values[start:stop])
            at = _first_beyond(shown[:, start:stop], limits)
            if at is None:
                regimes.append(_regime(days, values, start, stop, why, trend=False))
                break
            end, trend = _first_piece(days[start:stop], values[start:stop])
            if not trend and not 2 <= end <= at:
                end = _best_step(values[start:stop], at)
            regimes.append(_regime(days, values, start, start + end, why, trend=trend))
            if trend:
                alarms.append(_Alarm(start + at, start, True, math.nan, math.nan))
            if not trend or start + end < stop:
                alarms.append(_Alarm(start + (end if trend else at), start + end, False, math.nan, math.nan))
            start, why = start + end, "alarm"
    told = tuple(_with_step(alarm, values, regimes) for alarm in alarms)
    single, ewma, up, down = shown
    return Chart(single, ewma, up, down, limits, tuple(regimes), told)


def _self_starting(values: Floats) -> Floats:
    """Return each value against those before it as a standard normal number, shape (n,); zero for the first two."""
    n = len(values)
    out = np.zeros(n)
    for i in range(2, n):
        before = values[:i]
        spread, off = float(before.std(ddof=1)), float(values[i] - before.mean())
        # Equal values, as of a coarse instrument, tell nothing about how far the next one may be off.
        if spread > 1e-9 * max(float(np.abs(values).max()), 1e-300):
            tail = special.stdtr(i - 1, -abs(off) / (spread * math.sqrt(1 + 1 / i)))
            out[i] = math.copysign(-special.ndtri(max(float(tail), 1e-300)), off)
    return out


@lru_cache(maxsize=64)
def _limits_for(run_length: float) -> _ChartLimits:
    """Return limits that together give a false alarm in this many values, or more: each has three times the run length."""
    from scipy.optimize import brentq

    each = 3.0 * run_length

    def solved(length: Callable[[float], float], low: float, high: float) -> float:
        return float(brentq(lambda limit: math.log(length(limit) / each), low, high, xtol=1e-4))

    single = -float(special.ndtri(0.5 / each))
    return _ChartLimits(single, solved(_ewma_run_length, 0.1, 3.0), solved(_cusum_run_length, 0.5, 15.0))


def _ewma_run_length(limit: float) -> float:
    """Return the mean number of standard normal values until the EWMA is beyond ± limit."""
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    nodes, weights = nodes * limit, weights * limit
    steps = (nodes[None, :] - (1 - _WEIGHT) * nodes[:, None]) / _WEIGHT
    kernel = _density(steps) / _WEIGHT * weights
    lengths = np.linalg.solve(np.eye(_NODES) - kernel, np.ones(_NODES))
    return float(1 + (_density(nodes / _WEIGHT) / _WEIGHT * weights) @ lengths)


def _cusum_run_length(limit: float) -> float:
    """Return the mean number of standard normal values until either side of the CUSUM is beyond its limit."""
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    nodes, weights = np.r_[0.0, (nodes + 1) * limit / 2], np.r_[0.0, weights * limit / 2]
    kernel = _density(nodes[None, :] + _SLACK - nodes[:, None]) * weights
    kernel[:, 0] = special.ndtr(_SLACK - nodes)
    lengths = np.linalg.solve(np.eye(len(nodes)) - kernel, np.ones(len(nodes)))
    return float(lengths[0] / 2)


def crossing(days: Floats, values: Floats, limit: float) -> tuple[float, float, float] | None:
    """Return when a line through the values crosses a limit: the day, and the interval that covers 95 % (Fieller).

    None when fewer than four tests are there, the slope is not told from zero, or the line leads away from the limit.
    """
    if len(values) < _FEWEST or np.ptp(days) == 0.0:
        return None
    slope, level, middle, spread, sxx = _line(days, values)
    q = t_quantile(_COVERED, len(values) - 2) * spread
    c = level - limit
    square, cross, rest = slope**2 - q**2 / sxx, c * slope, c**2 - q**2 / len(values)
    if square <= 0.0:
        return None
    root = math.sqrt(max(cross**2 - square * rest, 0.0))
    early, late = (-cross - root) / square, (-cross + root) / square
    at = middle - c / slope
    return (at, middle + early, middle + late) if at > days[-1] else None


def _watched(values: Floats) -> Floats:
    """Return single values, EWMA and both sides of the CUSUM, shape (4, n)."""
    normal = _self_starting(values)
    out = np.zeros((4, len(values)))
    ewma = up = down = 0.0
    for i, z in enumerate(normal):
        ewma = (1 - _WEIGHT) * ewma + _WEIGHT * z
        up, down = max(0.0, up + z - _SLACK), max(0.0, down - z - _SLACK)
        out[:, i] = z, ewma, up, down
    return out


def _first_beyond(shown: Floats, limits: _ChartLimits) -> int | None:
    single, ewma, *cusum = np.abs(shown)
    beyond = (single > limits.single) | (ewma > limits.ewma) | (np.maximum(*cusum) > limits.cusum)
    return int(np.argmax(beyond)) if beyond.any() else None


def _best_step(values: Floats, at: int) -> int:
    """Return the first test after the step that describes values best, up to the alarm; two tests are before it."""

    def left(j: int) -> float:
        return sum(float(((part - part.mean()) ** 2).sum()) for part in (values[:j], values[j:]))

    return min(range(2, at + 1), key=left)


def _first_piece(days: Floats, values: Floats) -> tuple[int, bool]:
    """Return how many tests the first of the levels and lines covers that describe all best, and whether it is a line.

    The best by Schwarz's criterion, made stricter, of all ways to cut the tests into levels and lines of four tests or more (optimal
    partitioning); the variance is that of neighbours about each other, which changes do not enlarge.
    """
    n = len(values)
    # 0.4549: median of chi-squared with one degree of freedom.
    variance = float(np.median(np.diff(values) ** 2)) / (2 * 0.4549) or float(values.var()) or 1.0
    best = [0.0] * (n + 1)
    piece = [(0, False)] * (n + 1)
    for i in range(n - 1, -1, -1):
        costs: list[tuple[float, int, bool]] = []
        for j in range(i + 1, n + 1):
            for line in (False, True):
                if not line or (j - i >= _FEWEST and np.ptp(days[i:j]) > 0.0):
                    left = _left(days[i:j], values[i:j], line=line)
                    costs.append((left / variance + _STRICT * (3 if line else 2) * math.log(n) + best[j], j - i, line))
        best[i], length, line = min(costs)
        piece[i] = (length, line)
    return piece[0]


def _left(days: Floats, values: Floats, *, line: bool) -> float:
    """Return the sum of squares that a level, or a line, leaves."""
    off = values - values.mean()
    if line:
        x = days - days.mean()
        off = off - (x @ off) / (x @ x) * x
    return float(off @ off)


def _regime(days: Floats, values: Floats, first: int, stop: int, why: str, *, trend: bool) -> Regime:
    mine, n = values[first:stop], stop - first
    spread = float(mine.std(ddof=1)) if n > 1 else math.nan
    expanded = t_quantile(_COVERED, n - 1) * spread / math.sqrt(n) if n > 1 else math.nan
    floor = expanded * math.sqrt(n + 1) if n > 2 else math.nan
    slope = half = low = high = math.nan
    if n >= _FEWEST and np.ptp(days[first:stop]) > 0.0:
        slope, level, middle, off, sxx = _line(days[first:stop], mine)
        half = t_quantile(_COVERED, n - 2) * off / math.sqrt(sxx)
        if trend:
            floor = t_quantile(_COVERED, n - 2) * off * math.sqrt(1 + 1 / n)
        low, high = (level + slope * (float(days[i]) - middle) for i in (first, stop - 1))
    return Regime(first, stop - 1, why, float(mine.mean()), expanded, floor, slope, half, (low, high), trend)


def _with_step(alarm: _Alarm, values: Floats, regimes: Sequence[Regime]) -> _Alarm:
    """Return the alarm with the step where the levels, or lines, before and after it meet."""
    if alarm.trend:
        return alarm
    before = next(r for r in regimes if r.last == alarm.first - 1)
    after = next(r for r in regimes if r.first == alarm.first)
    sides = [(before, before.ends[1]), (after, after.ends[0])]
    # A line, at its end, is four times as uncertain as a level, in variance.
    parts = [(values[r.first : r.last + 1], 4.0 if r.trend else 1.0, end if r.trend else r.mean) for r, end in sides]
    dof = sum(len(part) for part, _, _ in parts) - sum(2 if r.trend else 1 for r, _ in sides)
    left = sum(_left(np.arange(len(part), dtype=float), part, line=times > 1.0) for part, times, _ in parts)
    pooled = math.sqrt(left / dof) if dof else math.nan
    half = t_quantile(_COVERED, dof) * pooled * math.sqrt(sum(n / len(p) for p, n, _ in parts)) if dof else math.nan
    return _Alarm(alarm.at, alarm.first, False, parts[1][2] - parts[0][2], half)


def _line(days: Floats, values: Floats) -> tuple[float, float, float, float, float]:
    """Return slope, level at the middle, the middle, deviation about the line, and the sum of squares of the days."""
    middle, level = float(days.mean()), float(values.mean())
    off = days - middle
    sxx = float(off @ off)
    slope = float(off @ (values - level)) / sxx
    left = values - level - slope * off
    return slope, level, middle, math.sqrt(float(left @ left) / (len(values) - 2)), sxx


def _density(z: Floats) -> Floats:
    return np.asarray(np.exp(-0.5 * z**2) / math.sqrt(2 * math.pi))
