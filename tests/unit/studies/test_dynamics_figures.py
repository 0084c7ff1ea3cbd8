"""Distances, figures and fitness against their definitions and an independent library."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from dtaidistance import dtw
from hypothesis import given, settings
from hypothesis import strategies as st

from dtwin.errors import InputError
from dtwin.schema import Floats
from studies.dynamics.distances import distances_um
from studies.dynamics.figures import dynamic_components, eq15, relative_difference, weighted_sum
from studies.dynamics.turns import one_turn

CURVES = st.lists(st.floats(-50.0, 50.0), min_size=1, max_size=7)


def by_definition(first: list[float], second: list[float]) -> tuple[float, float]:
    """Every warping path, one step at a time."""

    @cache
    def paths(i: int, j: int) -> tuple[float, float]:
        cost = (first[i] - second[j]) ** 2
        if (i, j) == (0, 0):
            return cost, cost
        came = [(i - 1, j), (i, j - 1), (i - 1, j - 1)]
        found = [paths(a, b) for a, b in came if a >= 0 and b >= 0]
        return cost + min(f[0] for f in found), max(cost, min(f[1] for f in found))

    total, bottleneck = paths(len(first) - 1, len(second) - 1)
    return math.sqrt(total), math.sqrt(bottleneck)


@settings(deadline=None)
@given(CURVES, CURVES)
def test_both_distances_are_the_best_over_all_warping_paths(first: list[float], second: list[float]) -> None:
    found = distances_um(np.array(first), np.array(second))
    assert found == pytest.approx(by_definition(first, second), abs=1e-6)


def test_warping_agrees_with_an_independent_library() -> None:
    rng = np.random.default_rng(1)
    first, second = rng.standard_normal(360), rng.standard_normal(300)
    assert distances_um(first, second)[0] == pytest.approx(dtw.distance(first, second), rel=1e-12)


def test_distances_of_known_curves() -> None:
    wave = np.sin(np.linspace(0.0, 6.0, 200))
    assert distances_um(wave, wave) == (0.0, 0.0)
    assert distances_um(np.zeros(50), np.full(40, 3.0))[1] == 3.0
    # Held readings cost nothing: time may stand still in one of the two.
    assert distances_um(np.repeat(wave, 3), wave)[0] == 0.0
    with pytest.raises(InputError, match="cannot be compared"):
        distances_um(np.zeros(1001), wave)
    with pytest.raises(InputError, match="cannot be compared"):
        distances_um(np.array([math.nan]), wave)


def test_the_printed_fitness_and_why_it_is_not_the_default() -> None:
    assert eq15(1.0, 1.0, 1.0) == pytest.approx(math.sqrt(3.0))
    assert eq15(1e-6, 1e-6, 1e-6) == pytest.approx(math.sqrt(3.0))
    assert eq15(100.0, 0.1, 0.01) == pytest.approx(1.0011, abs=1e-4)
    assert eq15(1.0, 0.0, 0.0) == 1.0
    with pytest.warns(RuntimeWarning, match="0/0"):
        assert math.isnan(eq15(0.0, 0.0, 0.0))
    assert weighted_sum(0.0, 0.0, 0.05, 360) == 0.0
    better, worse = weighted_sum(1.0, 1.0, 0.1, 360), weighted_sum(100.0, 0.1, 0.2, 360)
    assert better < worse


def test_components_are_rms_and_peak_to_peak_of_what_was_taken() -> None:
    angle = np.linspace(0.0, 2 * np.pi, 1000, endpoint=False)
    shape, shake = 10.0 * np.cos(2 * angle), np.where(np.arange(1000) % 2, 1.0, -1.0)
    found = dynamic_components(shape + shake, shape)
    assert (found.dc2_um, found.dc3_um) == pytest.approx((2.0, 1.0))
    assert found.dc1_um == pytest.approx(found.before_um - found.after_um)
    assert relative_difference(22.0, 20.0) == pytest.approx(0.1)
    with pytest.raises(InputError, match="no circular deviation"):
        relative_difference(1.0, 0.0)
    with pytest.raises(InputError, match="do not belong"):
        dynamic_components(shape, shape[1:])


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_turn_keeps_order_start_and_shape(sign: float) -> None:
    angle = 90.0 + sign * np.arange(0.0, 400.0, 0.09)
    turn = one_turn(angle, np.cos(np.radians(angle)), 360)
    assert turn.angle_deg[0] == 90.0
    assert np.diff(turn.angle_deg) == pytest.approx(sign)
    assert turn.deviation_um == pytest.approx(np.cos(np.radians(turn.angle_deg)), abs=1e-6)


def whole(readings: int) -> Floats:
    return np.arange(readings) * 360.0 / readings


@pytest.mark.parametrize(
    ("angle", "told"),
    [
        (whole(1000)[:900], "once round"),
        (np.delete(whole(1000), range(100, 120)), "once round"),
        (np.concatenate([whole(1000), [350.0]]), "turns back"),
        (np.where(whole(1000) == 90.0, math.nan, whole(1000)), "finite"),
        (whole(5), "at least 8"),
    ],
)
def test_what_is_not_a_turn_is_refused(angle: Floats, told: str) -> None:
    with pytest.raises(InputError, match=told):
        one_turn(angle, np.zeros(len(angle)), 360)


def test_a_turn_of_exactly_its_readings_is_itself() -> None:
    values = np.random.default_rng(0).standard_normal(360)
    assert np.array_equal(one_turn(whole(360), values, 360).deviation_um, values)
