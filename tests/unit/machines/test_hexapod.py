"""The virtual hexapod is a mechanism: what it does follows from its parameters."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from dtwin.errors import InputError
from dtwin.machines._sensors import read_ballbar
from dtwin.machines.hexapod import (
    _OVERSHOOT_DEG,
    VirtualHexapod,
    _HexapodRecording,
    _leg_lengths_kernel,
    _path_angle_rad,
)
from dtwin.machines.hexapod_parameters import CENTRE_MM, HexapodParameters
from dtwin.machines.motion import CircleCondition

PERFECT = replace(
    HexapodParameters().without_dynamics(),
    joint_centre_mm=0.0,
    leg_offset_mm=0.0,
    leg_scale_ppm=0.0,
    play_um=0.0,
    eccentricity_um=0.0,
    length_error_um=0.0,
)


@cache
def measured(feed: float, way: str = "CCW", parameters: HexapodParameters | None = None) -> _HexapodRecording:
    machine = VirtualHexapod(parameters, seed=0)
    return machine.measure(CircleCondition("YZ", 50.0, feed, way), setup="s1", repeat=1)


def spread_um(found: _HexapodRecording) -> float:
    return float(np.std(found.deviation_um[slice(*found.window)]))


def test_a_perfect_hexapod_runs_a_perfect_circle() -> None:
    found = measured(6000.0, parameters=PERFECT)
    # Noise of the bar and its last digit are left.
    assert np.abs(found.deviation_um).max() < 1.0
    assert spread_um(found) < 0.2


@pytest.mark.parametrize(("way", "sign"), [("CCW", 1.0), ("CW", -1.0)])
def test_the_turn_lies_between_two_half_turns_at_steady_feed(way: str, sign: float) -> None:
    found = measured(6000.0, way)
    start, end = found.window
    angle = found.angle_deg * sign
    assert angle[0] == pytest.approx(-_OVERSHOOT_DEG)
    assert angle[-1] == pytest.approx(360.0 + _OVERSHOOT_DEG)
    steps = np.diff(angle[start:end])
    assert steps == pytest.approx(np.degrees(100.0 / 50.0) / 1000.0, rel=1e-6)
    assert (end - start) * steps[0] == pytest.approx(360.0, abs=steps[0])


def test_leg_lengths_change_with_the_pose_as_their_derivative_says() -> None:
    legs = VirtualHexapod(seed=1).legs.true
    rows, other, length = np.empty((6, 6)), np.empty((6, 6)), np.empty((2, 6))
    pose = np.array([3.0, -20.0, 700.0, 1e-3, -2e-3, 5e-4])
    _leg_lengths_kernel(pose[:3], pose[3:], legs, length[0], rows)
    for column in range(6):
        nudged = pose + 1e-6 * (np.arange(6) == column)
        _leg_lengths_kernel(nudged[:3], nudged[3:], legs, length[1], other)
        # The rotation is of first order: its derivative is that of a small angle.
        assert (length[1] - length[0]) / 1e-6 == pytest.approx(rows[:, column], rel=1e-2, abs=0.6)


def test_longer_legs_lift_the_platform_as_their_triangle_says() -> None:
    machine = VirtualHexapod(PERFECT)
    height = float(CENTRE_MM[2] - PERFECT.tool_mm)
    length = np.empty(6)
    flat = np.array([0.0, 0.0, height])
    _leg_lengths_kernel(flat, np.zeros(3), machine.legs.true, length, np.empty((6, 6)))
    centre = machine.centre_mm()
    machine.legs.scale_1[:] = 1e-5
    lifted = machine.centre_mm() - centre
    assert centre == pytest.approx(CENTRE_MM, abs=1e-6)
    assert lifted == pytest.approx([0.0, 0.0, 1e-5 * length[0] ** 2 / height], abs=1e-6)


@pytest.mark.parametrize("radius_mm", [50.0, 100.0, 150.0])
def test_a_bar_reads_the_projected_error_to_second_order(radius_mm: float) -> None:
    rng = np.random.default_rng(0)
    angle = rng.uniform(0.0, 2 * np.pi, 500)
    outward = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(500)])
    error_mm = rng.uniform(-0.1, 0.1, (500, 3))
    bar = replace(PERFECT.bar, quantum_um=1e-6)
    for n in range(500):
        ball = np.tile(radius_mm * outward[n] + error_mm[n], (4, 1))
        clock = (0.0, 0.0, 1)
        read = read_ballbar(bar, ball, 1.0, np.zeros(3), radius_mm, clock, np.zeros(1))[0]
        size = float(np.linalg.norm(error_mm[n]))
        assert abs(read - error_mm[n] @ outward[n]) < 1.01 * size**2 / (2 * radius_mm)


def test_legs_that_follow_perfectly_put_the_ball_where_it_was_sent_at_the_edge_of_reach() -> None:
    machine = VirtualHexapod(PERFECT)
    condition = CircleCondition("YZ", 100.0, 12_000.0, "CCW")
    angle = _path_angle_rad(condition, PERFECT)
    spoke = 100.0 * np.column_stack([0 * angle, np.cos(angle), np.sin(angle)])
    assert np.abs(machine.tool_mm(condition, angle) - CENTRE_MM - spoke).max() < 1e-5


def test_dynamics_grow_with_the_feed_and_the_rest_does_not() -> None:
    quiet, still = HexapodParameters(), HexapodParameters().without_dynamics()
    slow, fast = (spread_um(measured(f, parameters=quiet)) for f in (1200.0, 6000.0))
    same = [spread_um(measured(f, parameters=still)) for f in (1200.0, 6000.0)]
    assert fast > 1.1 * slow
    assert same[0] == pytest.approx(same[1], rel=0.02)
    shaking = [np.std(measured(f).vibration.columns["spindle_y_g"]) for f in (1200.0, 6000.0)]
    assert shaking[1] > 5.0 * shaking[0]


def test_vibration_of_the_motors_is_where_their_screws_put_it() -> None:
    loud = replace(PERFECT, vibration_um_s_mm=0.5)
    found = measured(3000.0, parameters=loud)
    wave = np.asarray(found.vibration.columns["spindle_y_g"], dtype=float)
    power = np.abs(np.fft.rfft(wave)) ** 2
    hertz = np.fft.rfftfreq(len(wave), 1.0 / found.vibration.rate_hz)
    # 50 mm/s along the path moves a leg by at most 50 mm/s: 9 waves in 10 mm of it.
    assert power[hertz < 46.0].sum() > 0.9 * power.sum()


def test_the_same_seed_measures_the_same_and_another_does_not() -> None:
    condition = CircleCondition("YZ", 50.0, 6000.0, "CW")
    first, again, other = (VirtualHexapod(seed=s).measure(condition, setup="s1", repeat=1) for s in (0, 0, 1))
    assert np.array_equal(first.deviation_um, again.deviation_um)
    assert not np.array_equal(first.deviation_um, other.deviation_um)


def test_out_of_reach_is_refused() -> None:
    with pytest.raises(InputError, match="hexapod can do"):
        VirtualHexapod().measure(CircleCondition("YZ", 150.0, 1000.0, "CW"), setup="s", repeat=1)
