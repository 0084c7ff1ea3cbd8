"""The guard, case by case."""

from __future__ import annotations

import numpy as np
import pytest

from dtwin.errors import InputError
from dtwin.serve import safety
from dtwin.serve.interface import SafetyLimits
from dtwin.serve.safety import REASONS, Guard

LIMITS = SafetyLimits(clamp_um=50.0, slew_um_s=5000.0, stale_s=0.01, window_stale_s=0.1)
TICK_S = 0.002


def guard(limits: SafetyLimits = LIMITS) -> Guard:
    return Guard(limits, np.array([-1.0, 0.0]), np.array([1.0, 10.0]))


def step(g: Guard, wanted: tuple[float, float, float], **changes: float) -> str:
    inputs = changes.pop("inputs", np.array([0.0, 5.0]))
    given = {"age_s": 0.001, "elapsed_s": TICK_S} | changes
    g.step(np.array(wanted, dtype=float), inputs, **given)  # type: ignore[arg-type]
    return REASONS[g.reason]


def settled(g: Guard, wanted: tuple[float, float, float] = (30.0, 0.0, 0.0)) -> Guard:
    for _ in range(10):
        step(g, wanted)
    return g


def test_engages_without_a_jump_and_reaches_what_is_wanted() -> None:
    g = guard()
    sizes = []
    for _ in range(5):
        step(g, (30.0, 0.0, 0.0))
        sizes.append(g.out_um[0])
    np.testing.assert_allclose(sizes, [10, 20, 30, 30, 30])


def test_clamps_the_length_and_keeps_the_direction() -> None:
    g = settled(guard(), (300.0, -400.0, 0.0))
    np.testing.assert_allclose(g.out_um, [30.0, -40.0, 0.0], rtol=1e-12)
    assert step(g, (300.0, -400.0, 0.0)) == "clamped"


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e305])
def test_what_is_not_finite_is_led_to_zero(bad: float) -> None:
    for place in range(3):
        wanted = [1.0, 2.0, 3.0]
        wanted[place] = bad
        g = settled(guard())
        assert step(g, tuple(wanted)) == "not_finite"
        assert np.isfinite(g.out_um).all()
        for _ in range(5):
            step(g, tuple(wanted))
        assert g.at_rest
    g = settled(guard())
    assert step(g, (1.0, 0.0, 0.0), inputs=np.array([bad, 5.0])) == "not_finite"


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"age_s": 0.011}, "stale"),
        ({"age_s": np.nan}, "stale"),
        ({"age_s": -1.0}, "stale"),
        ({"window_age_s": 0.2}, "stale_window"),
        ({"window_age_s": np.inf}, "stale_window"),
        ({"device_ok": False}, "device_stopped"),
        ({"inputs": np.array([1.5, 5.0])}, "outside_box"),
        ({"enabled": False}, "disabled"),
    ],
)
def test_every_fault_releases_to_exactly_zero_and_says_why(changes: dict, reason: str) -> None:
    g = settled(guard())
    assert step(g, (30.0, 0.0, 0.0), **changes) == reason
    assert 0 < g.out_um[0] < 30
    for _ in range(4):
        step(g, (30.0, 0.0, 0.0), **changes)
    assert g.out_um.tolist() == [0.0, 0.0, 0.0]


def test_disabled_from_the_start_is_exactly_zero() -> None:
    g = guard()
    assert step(g, (30.0, 1.0, 2.0), enabled=False) == "disabled"
    assert g.out_um.tolist() == [0.0, 0.0, 0.0]


def test_shrinks_outside_the_box_where_that_is_wished() -> None:
    g = guard(SafetyLimits(50.0, 1e6, 0.01, 0.1, "shrink", 0.1))
    sizes = []
    for x in (1.0, 1.05, 1.1, 1.15, 1.2, 1.3):
        step(g, (30.0, 0.0, 0.0), inputs=np.array([x, 5.0]))
        sizes.append(round(float(g.out_um[0]), 9))
    assert sizes == [30.0, 22.5, 15.0, 7.5, 0.0, 0.0]


def test_latches_after_three_trips_and_needs_an_edge() -> None:
    g = guard()
    for trip in range(3):
        settled(g)
        step(g, (30.0, 0.0, 0.0), age_s=1.0)
        step(g, (30.0, 0.0, 0.0), age_s=1.0)
        assert g.trips == trip + 1
    settled(g)
    assert g.latched
    assert REASONS[g.reason] == "latched"
    assert g.at_rest
    step(g, (30.0, 0.0, 0.0), enabled=False)
    assert g.latched
    assert step(g, (30.0, 0.0, 0.0), enabled=True) != "latched"
    assert not g.latched
    assert g.out_um[0] > 0


def test_a_long_fault_is_one_trip() -> None:
    g = settled(guard())
    for _ in range(100):
        step(g, (30.0, 0.0, 0.0), age_s=1.0)
    assert g.trips == 1
    settled(g)
    assert g.out_um[0] == 30.0


def test_a_stall_earns_no_jump() -> None:
    g = guard(SafetyLimits(50.0, 100.0))
    step(g, (50.0, 0.0, 0.0), elapsed_s=3600.0)
    assert g.out_um[0] <= 100.0 * 0.02 + 1e-12
    for odd in (np.nan, -1.0):
        before = g.out_um.copy()
        step(g, (50.0, 0.0, 0.0), elapsed_s=odd)
        assert np.array_equal(g.out_um, before)


def test_reasons_are_counted() -> None:
    g = settled(guard())
    step(g, (30.0, 0.0, 0.0), age_s=1.0)
    assert g.counted()["stale"] == 1
    assert sum(g.counted().values()) == 11


def test_limits_that_switch_a_guard_off_are_refused() -> None:
    for name in ("clamp_um", "slew_um_s", "stale_s", "window_stale_s", "shrink_span"):
        for value in (0.0, -1.0, float("nan"), float("inf")):
            with pytest.raises(InputError, match="safety"):
                SafetyLimits(**{name: value})


def test_no_guard_was_optimised_away() -> None:
    nan = np.full(2, np.nan)
    assert safety.box_factor(nan, np.zeros(2), np.ones(2), 0.0) == -1.0
