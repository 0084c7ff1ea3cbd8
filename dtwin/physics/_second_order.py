"""How a second-order system answers a tone, and what is driven in step with it."""

from __future__ import annotations

from typing import Any

import numpy as np

from dtwin.physics.effect import Shape, moves, stacked
from dtwin.physics.state import State
from dtwin.schema import Floats

_LEAST_DAMPING = 0.005


def answer_to_tone(state: State, axis: str, frequency_hz: float, damping: float) -> Floats:
    """Return what a mode adds to a tone: its response to acceleration, and to velocity.

    With D = s^2 + 2 z w s + w^2 these are s^2 / D and s w / D, at the frequency of the tone. Errors
    of loops and structures in series are sums of such terms (partial fractions).

    ``frequency_hz``, ``damping``: natural frequency, and damping ratio.
    Returns (n, 2): um for a factor of one.
    """
    if not moves(state, axis):
        return np.zeros((state.n, 2))
    s = 1j * _rate_rad_s(state)
    mode_rad_s, denominator = _mode(s, frequency_hz, damping)
    turning = 1e3 * state.radius_mm * np.exp(1j * state.angle_rad)
    parts = [(turning * factor / denominator).imag for factor in (s**2, s * mode_rad_s)]
    return stacked(*parts) * state.sensitivity[axis][:, None]


def mode_columns(state: State, axis: str, shape: Shape) -> Floats:
    """Return ``answer_to_tone`` of a mode given by ``frequency_hz`` and ``damping``."""
    return answer_to_tone(state, axis, shape["frequency_hz"], shape["damping"])


def answer_to_force(state: State, force: Floats, frequency_hz: float, damping: float) -> Floats:
    """Return how a mode gives way to a force that repeats with the tone.

    ``state``: a tone, its points evenly spaced over one period.
    ``force``, (n,): as the deflection that it would cause if it stood.
    ``frequency_hz``, ``damping``: natural frequency, and damping ratio.
    Returns (n,).
    """
    s = 1j * _rate_rad_s(state) * np.arange(state.n // 2 + 1)
    mode_rad_s, denominator = _mode(s, frequency_hz, damping)
    return np.fft.irfft(np.fft.rfft(force) * mode_rad_s**2 / denominator, state.n)


def _rate_rad_s(state: State) -> float:
    return state.feed_mm_s / state.radius_mm


def _mode(s: Any, frequency_hz: float, damping: float) -> tuple[float, Any]:
    mode_rad_s = 2.0 * np.pi * frequency_hz
    damped = 2.0 * max(damping, _LEAST_DAMPING) * mode_rad_s
    return mode_rad_s, s**2 + damped * s + mode_rad_s**2
