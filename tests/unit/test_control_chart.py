"""The control chart of a figure: run lengths, changes, forecasts; the truth comes from numbers drawn here."""

from __future__ import annotations

import math

import numpy as np
import pytest

from dtwin.control_chart import (
    _cusum_run_length,
    _ewma_run_length,
    _limits_for,
    _regime,
    _self_starting,
    chart,
    crossing,
)

DAYS = np.arange(24.0) * 30.0


def test_run_lengths_are_those_of_published_tables() -> None:
    # Montgomery, Introduction to Statistical Quality Control: k = 1/2 and h = 5 give 465; lambda = 0.2, L = 2.86: 370.
    assert _cusum_run_length(5.0) == pytest.approx(465.0, rel=0.005)
    assert _ewma_run_length(2.86 * math.sqrt(0.2 / 1.8)) == pytest.approx(370.0, rel=0.01)


def test_all_limits_together_give_at_most_the_stated_rate_of_false_alarms() -> None:
    stated, limits = 50.0, _limits_for(50.0)
    rng, runs = np.random.default_rng(5), 2000
    ewma, up, down, length = (np.zeros(runs) for _ in range(4))
    going = np.full(runs, True)
    for _ in range(1500):
        z = rng.standard_normal(runs)
        ewma = 0.8 * ewma + 0.2 * z
        up, down = np.maximum(0.0, up + z - 0.5), np.maximum(0.0, down - z - 0.5)
        length += going
        beyond = (abs(z) > limits.single) | (abs(ewma) > limits.ewma) | (np.maximum(up, down) > limits.cusum)
        going &= ~beyond
    assert not going.any()
    assert stated < length.mean() < 2.0 * stated


def test_values_against_those_before_them_are_standard_normal_however_few() -> None:
    rng = np.random.default_rng(2)
    found = np.array([_self_starting(rng.normal(7.0, 0.3, 6)) for _ in range(4000)])
    assert (found[:, :2] == 0.0).all()
    assert found[:, 2:].std(axis=0) == pytest.approx(1.0, abs=0.04)
    assert np.abs(np.corrcoef(found[:, 2:].T) - np.eye(4)).max() < 0.06


@pytest.mark.parametrize("values", [np.full(9, 4.2), np.array([3.0]), np.array([3.0, 3.1])])
def test_few_or_equal_values_raise_no_alarm(values: np.ndarray) -> None:
    found = chart(DAYS[: len(values)], values, [], 200.0)
    assert found.alarms == ()
    assert [(r.first, r.last) for r in found.regimes] == [(0, len(values) - 1)]


def test_a_step_is_found_at_its_place_with_its_size() -> None:
    rng = np.random.default_rng(3)
    right = covered = 0
    for _ in range(100):
        values = rng.normal(5.0, 0.4, 24) + np.where(np.arange(24) >= 13, 4.0, 0.0)
        (alarm, *_) = chart(DAYS, values, [], 200.0).alarms
        right += alarm.first == 13
        covered += abs(alarm.step - 4.0) < alarm.expanded
    assert right >= 90
    assert covered >= 85


def test_wear_is_a_trend_and_its_forecast_covers_the_day_of_the_limit() -> None:
    rng = np.random.default_rng(4)
    trends = covered = told = 0
    for _ in range(100):
        values = 5.0 + 0.2 * np.arange(24) + rng.normal(0.0, 0.3, 24)
        found = chart(DAYS, values, [], 200.0)
        trends += found.regimes[-1].trend
        ahead = crossing(DAYS, values, 12.0)
        if ahead is not None:
            told += 1
            covered += ahead[1] <= 35 * 30.0 <= ahead[2]
    assert trends >= 90
    assert told == 100
    assert 89 <= covered <= 99


def test_nothing_is_forecast_where_the_line_may_as_well_be_level() -> None:
    rng = np.random.default_rng(6)
    told = sum(crossing(DAYS, rng.normal(5.0, 0.3, 24), 8.0) is not None for _ in range(200))
    assert told <= 12


def test_what_is_known_to_have_changed_is_no_alarm() -> None:
    values = np.random.default_rng(7).normal(5.0, 0.4, 24) + np.where(np.arange(24) >= 12, 6.0, 0.0)
    assert chart(DAYS, values, [12], 200.0).alarms == ()
    assert chart(DAYS, values, [], 200.0).alarms


def test_another_test_lies_within_the_noise_floor_as_often_as_it_says() -> None:
    rng = np.random.default_rng(3)
    values = rng.normal(5.0, 0.3, (3000, 6))
    for trend in (False, True):
        regimes = [_regime(np.arange(5.0), row[:5], 0, 5, "start", trend=trend) for row in values]
        # A line is extended from its middle here, where a further value would stand, too.
        middles = np.array([np.mean(r.ends) if trend else r.mean for r in regimes])
        inside = np.abs(values[:, 5] - middles) < [r.floor for r in regimes]
        assert 0.935 < inside.mean() < 0.965
