"""The commanded motion keeps its limits and its shape."""

from __future__ import annotations

import numpy as np
import pytest

from dtwin.errors import InputError
from dtwin.machines.motion import (
    DURATION_S,
    START_S,
    CircleCondition,
    MotionPlan,
    path_kernel,
    plan_motion,
    travelled_kernel,
)
from dtwin.machines.parameters import load_parameters

MOTION = load_parameters().motion
TICK_S = 0.002
CENTRE_MM = np.array([-550.0, 0.0, 75.0])


def planned(plane: str, radius_mm: float, feed_mm_min: float, direction: str) -> MotionPlan:
    condition = CircleCondition(plane, radius_mm, feed_mm_min, direction).standard()
    return plan_motion(condition, CENTRE_MM, MOTION, TICK_S)


def positions(plan: MotionPlan, step_s: float = TICK_S) -> np.ndarray:
    times = np.arange(0, plan.duration_s, step_s)
    out = np.empty((len(times), 3))
    for row, t in zip(out, times, strict=True):
        path_kernel(t, plan.segments, plan.frame, row)
    return out


@pytest.mark.parametrize("feed", [1000.0, 6000.0])
@pytest.mark.parametrize(("plane", "arcs"), [("XY", 4), ("YZ", 1), ("ZX", 1)])
def test_speed_acceleration_and_radius_stay_in_bounds(plane: str, arcs: int, feed: float) -> None:
    plan = planned(plane, 100.0, feed, "CCW")
    assert len(plan.segments) == arcs + 2
    path = positions(plan)
    speed = np.linalg.norm(np.diff(path, axis=0), axis=1) / TICK_S
    assert speed.max() == pytest.approx(feed / 60, rel=1e-3)
    radius = np.linalg.norm(path - CENTRE_MM, axis=1)
    assert radius.min() > 100 - 1e-9
    assert radius.max() == pytest.approx(101.5)
    tangential = np.diff(speed) / TICK_S
    assert np.abs(tangential).max() <= MOTION.acceleration_mm_s2 * 1.01


def test_rests_after_every_half_turn() -> None:
    plan = planned("XY", 100.0, 5000.0, "CW")
    path = positions(plan)
    for segment in plan.segments:
        at = round((segment[START_S]) / TICK_S)
        np.testing.assert_allclose(path[at], path[at - 10], atol=1e-9)
    start = path[round(plan.segments[1, START_S] / TICK_S)] - CENTRE_MM
    half = path[round(plan.segments[2, START_S] / TICK_S)] - CENTRE_MM
    np.testing.assert_allclose(start, [0, -100, 0], atol=1e-6)
    np.testing.assert_allclose(half, [0, 100, 0], atol=1e-6)


@pytest.mark.parametrize("direction", ["CCW", "CW"])
@pytest.mark.parametrize("plane", ["YZ", "ZX"])
def test_upright_arcs_pass_over_the_top(plane: str, direction: str) -> None:
    plan = planned(plane, 150.0, 4000.0, direction)
    path = positions(plan) - CENTRE_MM
    assert path[:, 2].max() == pytest.approx(150.0, abs=1e-3)
    swept = abs(plan.window_rad[1] - plan.window_rad[0])
    assert swept == pytest.approx(np.pi)
    assert path[:, 2].min() == pytest.approx(-151.5 * np.sin(np.radians(5)), abs=1e-3)


def test_exchanged_axes_flip_the_direction() -> None:
    condition = CircleCondition("XZ", 100.0, 2000.0, "CCW").standard()
    assert (condition.plane, condition.direction) == ("ZX", "CW")


def test_short_feed_arrives_without_reaching_its_speed() -> None:
    plan = planned("XY", 10.0, 30000.0, "CCW")
    segment = plan.segments[1]
    way = travelled_kernel(segment[DURATION_S], segment[DURATION_S], *segment[2:5])
    assert way == pytest.approx(10 * np.pi)
    assert segment[2] < 500


@pytest.mark.parametrize(
    "condition",
    [
        CircleCondition("XY", 100.0, 1000.0, "left"),
        CircleCondition("XY", -1.0, 1000.0, "CW"),
        CircleCondition("XY", 100.0, float("nan"), "CW"),
        CircleCondition("UV", 100.0, 1000.0, "CW"),
    ],
)
def test_senseless_conditions_are_refused(condition: CircleCondition) -> None:
    with pytest.raises(InputError):
        condition.standard()
