"""Particle swarm optimisation (Kennedy and Eberhart 1995) with an inertia that adapts.

Own code, because the libraries for it have had no release for years. A particle is drawn towards
its own best place and towards the best of all; the inertia doubles while the swarm keeps finding
better places and halves when it has not for a while.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from dtwin.errors import InputError
from dtwin.schema import Floats

_PUBLISHED_PARTICLES, _PUBLISHED_ITERATIONS = 50, 150
_SELF, _SOCIAL = 1.49, 1.5
_LEAST_INERTIA, _MOST_INERTIA = 0.1, 1.1
_FEW, _MANY = 2, 5


@dataclass(frozen=True)
class SwarmSettings:
    """How a swarm searches."""

    particles: int = _PUBLISHED_PARTICLES
    iterations: int = _PUBLISHED_ITERATIONS
    seed: int = 0

    def __post_init__(self) -> None:
        if self.particles < 2 or self.iterations < 1:
            raise InputError(
                "a swarm needs two particles and one iteration",
                code="swarm.size",
                got=f"{self.particles} particles, {self.iterations} iterations",
            )


@dataclass(frozen=True)
class _SwarmResult:
    """Best place of a swarm.

    ``place``, (m,): where.
    ``history``: best value after each iteration, the first one before any step.
    """

    place: Floats
    value: float
    history: tuple[float, ...]
    evaluations: int


def minimise(
    function: Callable[[Floats], float], bounds: Sequence[tuple[float, float]], settings: SwarmSettings
) -> _SwarmResult:
    """Return the best place that a swarm finds inside of bounds.

    ``function``: takes a place, shape (m,); NaN counts as worse than anything.
    """
    low, high = np.array(bounds, dtype=float).T
    if not (low < high).all():
        raise InputError("a bound is not a range", code="swarm.bounds", got=str(list(bounds))[:120])
    rng = np.random.default_rng(settings.seed)
    shape = (settings.particles, len(low))
    place = rng.uniform(low, high, shape)
    speed = rng.uniform(low - high, high - low, shape)
    own, own_value = place.copy(), _values(function, place)
    best = int(np.argmin(own_value))
    history = [float(own_value[best])]
    inertia, stalled = _MOST_INERTIA, 0
    for _ in range(settings.iterations):
        towards_own, towards_best = rng.random(shape), rng.random(shape)
        speed = inertia * speed + _SELF * towards_own * (own - place)
        speed += _SOCIAL * towards_best * (own[best] - place)
        moved = place + speed
        place = np.clip(moved, low, high)
        speed[moved != place] = 0.0
        value = _values(function, place)
        better = value < own_value
        own[better], own_value[better] = place[better], value[better]
        best = int(np.argmin(own_value))
        stalled = max(0, stalled - 1) if own_value[best] < history[-1] else stalled + 1
        inertia *= 2.0 if stalled < _FEW else 0.5 if stalled > _MANY else 1.0
        inertia = min(max(inertia, _LEAST_INERTIA), _MOST_INERTIA)
        history.append(float(own_value[best]))
    calls = settings.particles * (settings.iterations + 1)
    return _SwarmResult(own[best], history[-1], tuple(history), calls)


def _values(function: Callable[[Floats], float], places: Floats) -> Floats:
    values = np.array([function(place) for place in places])
    return np.where(np.isnan(values), np.inf, values)
