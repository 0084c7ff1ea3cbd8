"""Displacement from acceleration by double integration, and what that cannot see.

A spectrum threshold, whose cut-off a particle swarm chooses, then two integrations that restart in
every window; kept for comparison.

Source: the thesis from which this project starts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dtwin.errors import InputError
from dtwin.schema import Floats
from dtwin.units import G_MM_S2


def power_threshold_filter(signal: Floats, cutoff_power: float) -> Floats:
    """Keep the spectral lines whose power |X[k]|^2 / n exceeds a threshold.

    ``signal``, (..., n): records, for example in g.
    ``cutoff_power``: threshold in the square of the signal's unit; it depends on n.
    """
    n = signal.shape[-1]
    spectrum = np.fft.rfft(signal, axis=-1)
    power = np.abs(spectrum) ** 2 / n
    return np.fft.irfft(np.where(power > cutoff_power, spectrum, 0), n, axis=-1)


@dataclass(frozen=True)
class _SwarmResult:
    """Best point that a swarm found."""

    position: float
    value: float


def swarm_minimum(
    objective: Callable[[float], float],
    low: float,
    high: float,
    *,
    particles: int = 24,
    iterations: int = 60,
    patience: int = 15,
    seed: int = 0,
) -> _SwarmResult:
    """Minimise a function of one positive number by particle swarm, on a log scale.

    Constriction coefficients of Clerc and Kennedy, IEEE Trans. Evol. Comput. 6 (2002).

    ``objective``: function of the argument; values that are not finite count as worst.
    ``low``, ``high``: positive bounds.
    ``patience``: iterations without improvement after which the search ends.
    Raises ``InputError`` when the bounds are not positive and ordered.
    """
    if not 0 < low < high < np.inf:
        raise InputError("bounds must be positive and ordered", code="swarm.bounds", got=f"{low} to {high}")

    def worth(log_position: float) -> float:
        value = float(objective(float(np.exp(log_position))))
        return value if np.isfinite(value) else np.inf

    inertia, pull = 0.7298, 1.4962
    bounds = np.log(low), np.log(high)
    rng = np.random.default_rng(seed)
    at = rng.uniform(*bounds, particles)
    speed = np.zeros(particles)
    best_at, best = at.copy(), np.array([worth(x) for x in at])
    leader, idle, done = int(np.argmin(best)), 0, 0
    while done < iterations and idle < patience:
        done += 1
        own, shared = rng.random(particles), rng.random(particles)
        speed = inertia * speed + pull * own * (best_at - at)
        speed += pull * shared * (best_at[leader] - at)
        at = np.clip(at + speed, *bounds)
        value = np.array([worth(x) for x in at])
        better = value < best
        best_at[better], best[better] = at[better], value[better]
        previous, leader = best[leader], int(np.argmin(best))
        idle = 0 if best[leader] < previous else idle + 1
    return _SwarmResult(float(np.exp(best_at[leader])), float(best[leader]))


def integrate(signal: Floats, rate_hz: float) -> Floats:
    """Return the running trapezoidal integral along the last axis, zero at the start."""
    steps = 0.5 * (signal[..., 1:] + signal[..., :-1]) / rate_hz
    total = np.zeros_like(signal)
    np.cumsum(steps, axis=-1, out=total[..., 1:])
    return total


def displacement_mm(acceleration_g: Floats, rate_hz: float, cutoff_power: float = 0.0) -> Floats:
    """Return displacement by the threshold filter and two integrations from rest.

    ``acceleration_g`` (..., n): one window per row; every window restarts at zero speed and position.
    ``cutoff_power``: threshold of ``power_threshold_filter`` in g^2; 0 keeps every line.
    """
    kept = power_threshold_filter(acceleration_g, cutoff_power)
    return integrate(integrate(kept * G_MM_S2, rate_hz), rate_hz)


def coupled(signal: Floats, rate_hz: float, corner_hz: float = 0.5) -> Floats:
    """Return what a first-order AC coupling lets through (bilinear, from rest).

    ``signal``, (n,): record.
    ``rate_hz``, ``corner_hz``: sample rate and -3 dB frequency.
    """
    from scipy.signal import butter, lfilter

    return np.asarray(lfilter(*butter(1, corner_hz, "high", fs=rate_hz), signal - signal[0]))


@dataclass(frozen=True)
class Visibility:
    """How much of a known displacement comes back.

    ``lost_fraction``: energy of (true - found) over energy of true; 0 is perfect, 1 no better than answering zero,
    above 1 worse than that.
    ``correlation``: between true and found displacement; 0 when one of them is constant.
    ``found_rms_mm``, ``true_rms_mm``: sizes of the two, without their means.
    """

    lost_fraction: float
    correlation: float
    found_rms_mm: float
    true_rms_mm: float


def displacement_visibility(
    motion_mm: Floats,
    rate_hz: float,
    window: int,
    *,
    corner_hz: float = 0.5,
    cutoff_power: float = 0.0,
    per_window_mean: bool = False,
) -> Visibility:
    """Send a known motion through sensor coupling and window restarts and compare.

    ``motion_mm``, shape (n,): true displacement; its second difference is the true acceleration.
    ``window``: samples after which the integration restarts.
    ``corner_hz``: corner of the AC coupling; 0 for a sensor that measures down to rest.
    ``cutoff_power``: threshold of the spectrum filter in g^2.
    ``per_window_mean``: compare means over windows, one number per window.
    Raises ``InputError`` when there are fewer than two windows, or the motion is constant.
    """
    acceleration_g = np.zeros(len(motion_mm))
    acceleration_g[1:-1] = np.diff(motion_mm, 2) * rate_hz**2 / G_MM_S2
    acceleration_g[0], acceleration_g[-1] = acceleration_g[1], acceleration_g[-2]
    if corner_hz > 0:
        acceleration_g = coupled(acceleration_g, rate_hz, corner_hz)
    count = len(motion_mm) // window
    if count < 2:
        raise InputError(
            "the motion is shorter than two windows",
            code="integration.short",
            got=f"{len(motion_mm)} samples",
            allowed=f">= {2 * window}",
        )
    rows = acceleration_g[: count * window].reshape(count, window)
    integrated = displacement_mm(rows, rate_hz, cutoff_power)
    true = motion_mm[: count * window].reshape(count, window)
    if per_window_mean:
        integrated, true = integrated.mean(axis=1), true.mean(axis=1)
    return _compared(true.reshape(-1), integrated.reshape(-1))


def _compared(true: Floats, estimated: Floats) -> Visibility:
    true, estimated = true - true.mean(), estimated - estimated.mean()
    energy, size = float(true @ true), float(estimated @ estimated)
    if energy <= 0:
        raise InputError("the known motion is constant", code="integration.constant")
    lost = float((true - estimated) @ (true - estimated)) / energy
    correlation = float(true @ estimated) / np.sqrt(energy * size) if size > 0 else 0.0
    return Visibility(lost, float(correlation), float(np.sqrt(size / len(true))), float(np.sqrt(energy / len(true))))
