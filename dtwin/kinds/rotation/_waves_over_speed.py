"""Waves of a turn that are not the same at all speeds: no form of a target does so."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dtwin.kinds.rotation._orders import Order
from dtwin.kinds.rotation._turns import Turns, synchronous_um
from dtwin.schema import Floats
from dtwin.statistics import k2_factor

_HIGHEST = 40
_BLOCKS = 10
_LARGE = 4.0
"""Times what covers 95 % of the scatter of an amplitude."""
_MATTERS, _LINEAR = 0.05, 2e-3
"""Part of the largest synchronous error, without what comes once per turn, and of the run-out, of which a probe makes waves."""
_SAME_HZ = 0.02
_FEWEST = 3


@dataclass(frozen=True)
class MovingWave:
    """The wave whose amplitude changes most from speed to speed; ``times``: how often per turn; at which speeds it is smallest and largest."""

    times: int
    least_um: float
    least_rpm: float
    most_um: float
    most_rpm: float


def moving_wave(turns: Sequence[Turns], speed_rpm: Floats, lines: Sequence[Sequence[Order]]) -> MovingWave | None:
    """Return the wave of two times per turn or more whose amplitude changes, if it surely does; None of two speeds and fewer.

    ``lines``: what stands between whole orders, by run. A frequency of its own that is a whole order at one speed is no change there.
    """
    if len(np.unique(np.round(speed_rpm, -1))) < _FEWEST or any(run.n < _FEWEST for run in turns):
        return None
    bins = min(run.moved_um.shape[1] for run in turns)
    orders = np.arange(2, min(_HIGHEST, bins // 4) + 1)
    told = [_amplitudes(run, orders) for run in turns]
    size, unsure = (np.array([one[k] for one in told]) for k in (0, 1))
    hertz = {line.order * rpm / 60.0 for rpm, of_run in zip(speed_rpm, lines, strict=True) for line in of_run}
    own = np.outer(speed_rpm / 60.0, orders)
    alien = np.any([np.abs(own - hz) < _SAME_HZ * hz for hz in hertz], axis=0) if hertz else np.zeros_like(own, bool)
    low, high = np.where(alien, np.inf, size), np.where(alien, -np.inf, size)
    change = high.max(axis=0) - low.min(axis=0)
    synchronous = max(float(np.ptp(synchronous_um(run)[1])) for run in turns)
    runout = max(float(np.ptp(run.read_um, axis=1).mean()) for run in turns)
    least = max(_MATTERS * synchronous, _LINEAR * runout, *(run.step_um for run in turns))
    sure = change > np.maximum(_LARGE * unsure.max(axis=0), least)
    if not sure.any():
        return None
    best = int(np.argmax(np.where(sure, change, 0.0)))
    least, most = int(np.argmin(low[:, best])), int(np.argmax(high[:, best]))
    at = float(size[least, best]), float(speed_rpm[least]), float(size[most, best]), float(speed_rpm[most])
    return MovingWave(int(orders[best]), *at)


def _amplitudes(turns: Turns, orders: Floats) -> tuple[Floats, Floats]:
    """Return the amplitudes of the mean turn, and what covers 95 % of their scatter by blocks of turns."""
    waves = (
        2.0 / turns.moved_um.shape[1] * (turns.moved_um @ np.exp(1j * np.outer(np.radians(turns.angle_deg), orders)))
    )
    parts = np.array_split(waves, min(turns.n, _BLOCKS))
    means = np.array([part.mean(axis=0) for part in parts])
    scatter = np.sqrt(np.var(means, axis=0, ddof=1) / len(parts))
    return np.abs(waves.mean(axis=0)), k2_factor(len(parts) - 1.0) * scatter
