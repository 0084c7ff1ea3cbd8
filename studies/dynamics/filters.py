"""Filters that part a turn into what is static and what is dynamic, behind one interface.

An unscented Kalman filter is nothing without its state and its two functions. Source: Xing et al. (2024),
which prints neither; the models here are stated instead, so that a figure can be judged:

``random-walk``
    State: the deviation, um. f(x) = x, h(x) = x. Linear, so the scaling alpha cannot matter.
``circle``
    State: place of the ball about the nominal centre, two coordinates, um. f turns it by one step
    of the angle, h(x) is its distance from the centre minus the nominal radius, um.

``Q`` is per reading and per coordinate, ``R`` per reading, both um^2: the same numbers smooth 360
readings per revolution far more than 3600.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from dtwin.errors import InputError
from dtwin.features.compiled import compiled
from dtwin.schema import Floats
from dtwin.units import UM_PER_MM

MODELS = ("random-walk", "circle")
PUBLISHED_Q_UM2, PUBLISHED_R_UM2, PUBLISHED_P_UM2 = 1e-3, 1.0, 1e-2
"""Noise covariances and first covariance as published without units; um is assumed."""
_BETA, _KAPPA = 2.0, 0.0
_ALPHAS = (1e-5, 1.0)
_CIRCLE = 1
_PROBE_UM = 10.0


class Filter(Protocol):
    """What takes the dynamic part out of a turn."""

    @property
    def name(self) -> str:
        """What the filter is, with its settings."""

    def static_um(self, deviation_um: Floats) -> Floats:
        """Return the static part of a closed turn, read at equal steps of the angle in the order of travel, (n,).

        What runs forwards only has gone round once before: the turn is closed.
        """


@dataclass(frozen=True)
class _RandomWalk:
    """A deviation that wanders.

    Attributes:
        q_um2, r_um2, p_um2: Variance of a step, of a reading, and of the first state.
    """

    q_um2: float = PUBLISHED_Q_UM2
    r_um2: float = PUBLISHED_R_UM2
    p_um2: float = PUBLISHED_P_UM2

    def __post_init__(self) -> None:
        _require_variances(self.q_um2, self.r_um2, self.p_um2)

    def _named(self, way: str) -> str:
        return f"{way}, random walk, Q {self.q_um2:.3g} R {self.r_um2:.3g} um2"


class RandomWalkFilter(_RandomWalk):
    """Linear Kalman filter of a deviation that wanders, forwards only."""

    @property
    def name(self) -> str:
        """What the filter is."""
        return self._named("Kalman filter")

    def static_um(self, deviation_um: Floats) -> Floats:
        """Return the filtered turn."""
        twice = np.tile(deviation_um, 2)
        filtered, _, _, _ = kalman_kernel(twice, self.q_um2, self.r_um2, self.p_um2)
        return np.asarray(filtered[len(deviation_um) :])


class Smoother(_RandomWalk):
    """Rauch-Tung-Striebel smoother of the same random walk: forwards and back, without lag."""

    @property
    def name(self) -> str:
        """What the filter is."""
        return self._named("RTS smoother")

    def static_um(self, deviation_um: Floats) -> Floats:
        """Return the smoothed turn."""
        n = len(deviation_um)
        thrice = np.tile(deviation_um, 3)
        filtered = kalman_kernel(thrice, self.q_um2, self.r_um2, self.p_um2)
        return np.asarray(smooth_kernel(*filtered)[n : 2 * n])


@dataclass(frozen=True)
class UnscentedFilter:
    """Unscented Kalman filter (Wan and van der Merwe 2000), scaled, beta 2, kappa 0.

    Attributes:
        model: One of ``MODELS``.
        alpha: Scaling of the sigma points, 1e-5 to 1; the one number that is tuned in the published method.
        q_um2, r_um2, p_um2: As for :class:`RandomWalkFilter`.
        radius_mm: Nominal radius; only the model ``circle`` uses it.
    """

    model: str = "random-walk"
    alpha: float = 0.1
    q_um2: float = PUBLISHED_Q_UM2
    r_um2: float = PUBLISHED_R_UM2
    p_um2: float = PUBLISHED_P_UM2
    radius_mm: float = 50.0

    def __post_init__(self) -> None:
        _require_variances(self.q_um2, self.r_um2, self.p_um2)
        if self.model not in MODELS:
            raise InputError(
                "no such model of a filter", code="dynamics.model", got=self.model[:40], allowed=", ".join(MODELS)
            )
        if not _ALPHAS[0] <= self.alpha <= _ALPHAS[1] or not self.radius_mm > 0.0:
            raise InputError(
                "the filter cannot be set so",
                code="dynamics.filter",
                got=f"alpha {self.alpha:g}, radius {self.radius_mm:g} mm",
                allowed=f"alpha {_ALPHAS[0]:g} to {_ALPHAS[1]:g}, radius above 0",
            )

    @property
    def name(self) -> str:
        """What the filter is."""
        return (
            f"unscented Kalman filter, {self.model}, alpha {self.alpha:.3g}, Q {self.q_um2:.3g} R {self.r_um2:.3g} um2"
        )

    def static_um(self, deviation_um: Floats) -> Floats:
        """Return the filtered turn."""
        n = len(deviation_um)
        kind = MODELS.index(self.model)
        twice = np.tile(deviation_um, 2)
        settings = np.array([self.alpha, self.q_um2, self.r_um2, self.p_um2])
        filtered = unscented_kernel(twice, kind, UM_PER_MM * self.radius_mm, 2.0 * np.pi / n, settings)
        return np.asarray(filtered[n:])


@dataclass(frozen=True)
class LowPass:
    """Zero-phase low-pass along the angle: a Butterworth of second order, forwards and back.

    Attributes:
        cutoff_upr: Undulations per revolution that pass by half.
    """

    cutoff_upr: float = 15.0

    def __post_init__(self) -> None:
        if not self.cutoff_upr > 0.0:
            raise InputError("the cutoff must be above zero", code="dynamics.cutoff", got=f"{self.cutoff_upr:g}")

    @property
    def name(self) -> str:
        """What the filter is."""
        return f"zero-phase low-pass, {self.cutoff_upr:g} undulations per revolution"

    def static_um(self, deviation_um: Floats) -> Floats:
        """Return the smoothed turn."""
        waves = np.fft.rfft(deviation_um)
        gain = 1.0 / (1.0 + (np.arange(len(waves)) / self.cutoff_upr) ** 4)
        return np.fft.irfft(gain * waves, len(deviation_um))


@dataclass(frozen=True)
class Response:
    """What a filter does to a real feature of so many lobes.

    Attributes:
        lobes: Undulations per revolution.
        gain: Amplitude that is left, 1 for all.
        lag_deg: By how much the feature comes late, degrees of the path.
        taken: Share of the feature that is counted as dynamic: amplitude of what was taken out.
    """

    lobes: int
    gain: float
    lag_deg: float
    taken: float


def response(chosen: Filter, readings: int, lobes: int = 2) -> Response:
    """Measure what a filter does to a feature, by filtering one.

    Args:
        readings: Readings per revolution.
        lobes: Undulations per revolution: 2 is what scale, squareness and servo mismatch make.
    """
    wave = _PROBE_UM * np.cos(lobes * np.arange(readings) * (2.0 * np.pi / readings))
    left = np.fft.rfft(chosen.static_um(wave))[lobes] / np.fft.rfft(wave)[lobes]
    lag_deg = float(-np.degrees(np.angle(left)) / lobes)
    return Response(lobes, float(np.abs(left)), lag_deg, float(np.abs(1.0 - left)))


def _require_variances(q_um2: float, r_um2: float, p_um2: float) -> None:
    if not (q_um2 > 0.0 and r_um2 > 0.0 and p_um2 >= 0.0):
        raise InputError(
            "a variance is not above zero",
            code="dynamics.variance",
            got=f"Q {q_um2:g}, R {r_um2:g}, first P {p_um2:g} um2",
        )


@compiled
def kalman_kernel(read: Floats, q: float, r: float, p: float) -> tuple[Floats, Floats, Floats, Floats]:
    """Filter a scalar random walk; returns states and variances, after and before each reading."""
    n = read.shape[0]
    state, variance, expected, spread = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    x = read[0]
    for i in range(n):
        expected[i], spread[i] = x, p + q
        gain = spread[i] / (spread[i] + r)
        x = expected[i] + gain * (read[i] - expected[i])
        p = (1.0 - gain) * spread[i]
        state[i], variance[i] = x, p
    return state, variance, expected, spread


@compiled
def smooth_kernel(state: Floats, variance: Floats, expected: Floats, spread: Floats) -> Floats:
    """Go back over what :func:`kalman_kernel` returned."""
    out = state.copy()
    for i in range(state.shape[0] - 2, -1, -1):
        out[i] += variance[i] / spread[i + 1] * (out[i + 1] - expected[i + 1])
    return out


@compiled
def _move(kind: int, x: Floats, step_rad: float) -> None:
    if kind == _CIRCLE:
        c, s = np.cos(step_rad), np.sin(step_rad)
        x[0], x[1] = c * x[0] - s * x[1], s * x[0] + c * x[1]


@compiled
def _seen(kind: int, x: Floats, radius_um: float) -> float:
    if kind == _CIRCLE:
        return float(np.hypot(x[0], x[1]) - radius_um)
    return float(x[0])


@compiled
def _drawn(x: Floats, p: Floats, scale: float) -> Floats:
    """Sigma points, shape (2 L + 1, L)."""
    size = x.shape[0]
    # Cholesky by hand: numba takes five seconds to compile the library's.
    root = np.zeros((size, size))
    points = np.empty((2 * size + 1, size))
    for i in range(size):
        for j in range(i + 1):
            rest = scale * p[i, j]
            for k in range(j):
                rest -= root[i, k] * root[j, k]
            root[i, j] = np.sqrt(rest) if i == j else rest / root[j, j]
    for i in range(size):
        points[0, i] = x[i]
        for j in range(size):
            points[1 + j, i] = x[i] + root[i, j]
            points[1 + size + j, i] = x[i] - root[i, j]
    return points


@compiled
def unscented_kernel(read: Floats, kind: int, radius_um: float, step_rad: float, settings: Floats) -> Floats:
    """Filter readings with the unscented transform.

    Args:
        read: Deviation, um. Shape (n,).
        kind: Place of the model in ``MODELS``.
        radius_um: Nominal radius.
        step_rad: Angle between readings.
        settings: alpha, and the variances Q, R and first P, um^2. Shape (4,).

    Returns:
        Deviation that the filtered state stands for. Shape (n,).
    """
    alpha, q, r, first = settings
    size = 2 if kind == _CIRCLE else 1
    scale = alpha * alpha * (size + _KAPPA)
    each, count = 0.5 / scale, 2 * size + 1
    middle_weight = 2.0 - size / scale - alpha * alpha + _BETA
    x, p = np.zeros(size), np.zeros((size, size))
    x[0] = radius_um + read[0] if kind == _CIRCLE else read[0]
    for i in range(size):
        p[i, i] = first
    seen, cross, out = np.empty(count), np.empty(size), np.empty(read.shape[0])
    for n in range(read.shape[0]):
        points = _drawn(x, p, scale)
        for k in range(count):
            _move(kind, points[k], step_rad if n > 0 else 0.0)
        # Means about the middle point: the weights are huge and of both signs when alpha is small.
        for i in range(size):
            shift = 0.0
            for k in range(1, count):
                shift += each * (points[k, i] - points[0, i])
            x[i] = points[0, i] + shift
        for i in range(size):
            for j in range(size):
                p[i, j] = q if i == j else 0.0
                for k in range(count):
                    weight = middle_weight if k == 0 else each
                    p[i, j] += weight * (points[k, i] - x[i]) * (points[k, j] - x[j])
        points = _drawn(x, p, scale)
        expected = 0.0
        for k in range(count):
            seen[k] = _seen(kind, points[k], radius_um)
            expected += each * (seen[k] - seen[0])
        expected += seen[0]
        spread = r
        cross[:] = 0.0
        for k in range(count):
            weight = middle_weight if k == 0 else each
            spread += weight * (seen[k] - expected) ** 2
            for i in range(size):
                cross[i] += weight * (points[k, i] - x[i]) * (seen[k] - expected)
        for i in range(size):
            x[i] += cross[i] / spread * (read[n] - expected)
            for j in range(size):
                p[i, j] -= cross[i] * cross[j] / spread
        out[n] = _seen(kind, x, radius_um)
    return out
