"""The swarm finds what is there to be found, and says when nothing is."""

from __future__ import annotations

import math

import numpy as np
import pytest

from dtwin.errors import InputError
from dtwin.schema import Floats
from studies.dynamics.filters import UnscentedFilter
from studies.dynamics.swarm import SwarmSettings, minimise
from studies.dynamics.tuning import judge, sensitivity, tune

SMALL = SwarmSettings(particles=8, iterations=10, seed=3)
ANGLE = np.linspace(0.0, 2 * np.pi, 360, endpoint=False)
SLOW = 12.0 * np.cos(2 * ANGLE) + 3.0 * np.sin(5 * ANGLE)
FAST = SLOW + 6.0 * (np.random.default_rng(1).random(360) - 0.5)


def test_the_swarm_finds_the_lowest_of_many_hollows_and_does_so_again() -> None:
    def rastrigin(place: Floats) -> float:
        return float(np.sum(place**2 - 10.0 * np.cos(2 * np.pi * place) + 10.0))

    bounds = [(-5.0, 4.0)] * 2
    found, again = (minimise(rastrigin, bounds, SwarmSettings(seed=2)) for _ in range(2))
    assert found.value < 1e-6
    assert np.abs(found.place).max() < 1e-3
    assert np.array_equal(found.place, again.place)
    assert found.evaluations == 50 * 151
    assert all(b <= a for a, b in zip(found.history, found.history[1:], strict=False))


def test_a_swarm_stays_inside_and_takes_nan_for_the_worst() -> None:
    def broken_above_one(place: Floats) -> float:
        return float(place[0]) if place[0] <= 1.0 else math.nan

    found = minimise(broken_above_one, [(0.25, 3.0)], SMALL)
    assert found.place[0] == 0.25
    with pytest.raises(InputError, match="not a range"):
        minimise(broken_above_one, [(1.0, 1.0)], SMALL)
    with pytest.raises(InputError, match="two particles"):
        SwarmSettings(particles=1)


def test_the_ratio_is_found_and_alpha_is_told_to_be_inert() -> None:
    start = UnscentedFilter()
    found = tune(FAST, SLOW, start, settings=SMALL)
    assert not found.inert
    assert found.judged.fitness < 0.9 * found.unfiltered.fitness
    assert found.judged.fitness < judge(start.static_um(FAST), SLOW, "weighted_sum").fitness
    assert tune(FAST, SLOW, start, tuned="alpha", settings=SMALL).inert


def test_the_printed_fitness_prefers_a_worse_curve() -> None:
    """The reason why it is behind a flag."""
    sane = tune(FAST, SLOW, UnscentedFilter(), settings=SMALL)
    printed = tune(FAST, SLOW, UnscentedFilter(), fitness="eq15", settings=SMALL)
    assert 1.0 <= printed.judged.fitness <= math.sqrt(3.0)
    assert printed.judged.dtw_um > sane.judged.dtw_um
    assert printed.judged.difference > sane.judged.difference


def test_the_circle_feels_alpha_a_little() -> None:
    circles = [UnscentedFilter("circle", a) for a in (1e-3, 0.1, 1.0)]
    left = sensitivity(FAST, circles)
    assert 0.0 < np.ptp(left) < 1.0


def test_choices_that_do_not_exist_are_refused() -> None:
    for wrong in ({"tuned": "kappa"}, {"fitness": "eq16"}):
        with pytest.raises(InputError, match="no such choice"):
            tune(FAST, SLOW, UnscentedFilter(), settings=SMALL, **wrong)
