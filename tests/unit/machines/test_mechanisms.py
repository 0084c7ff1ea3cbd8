"""Each mechanism of the virtual cobot does what its physics says."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from dtwin.errors import InputError
from dtwin.kinematics import UR10E
from dtwin.machines._joints import (
    _SHAPE,
    COMPLIANCE,
    gravity_torque_kernel,
    joint_table,
    mode_table,
    modes_kernel,
    play_kernel,
    transmission_kernel,
    transmission_table,
    wind_up_kernel,
)
from dtwin.machines._sensors import _couple_kernel, _resample_kernel, accelerometer_group, drift_kernel, read_ballbar
from dtwin.machines.parameters import load_parameters

PARAMETERS = load_parameters()
TICK_S, REACH_MM = 0.002, 550.0


def test_play_has_a_width_and_a_memory() -> None:
    link, seen = 0.0, []
    for angle in [0.0, 1.0, 2.0, 1.5, 1.0, 0.0]:
        link = play_kernel(angle, link, 1.0)
        seen.append(link)
    assert seen == [0.0, 0.5, 1.5, 1.5, 1.5, 0.5]


def test_flanks_have_their_own_ripple_but_share_eccentricity() -> None:
    table = transmission_table(PARAMETERS.joints, np.random.default_rng(3))
    # Even, so that its lines stand apart: at integer orders, and not modulated.
    joints = replace(PARAMETERS.joints, flexspline_1=0.0)
    orders = np.array([1.0, 2.0, 3.0, 100.0, 200.0, 400.0])
    low = orders < joints.flank_orders_from
    angle = np.linspace(0, 0.2, 400)

    def ripple(flank: float, kept: np.ndarray) -> np.ndarray:
        rows = table[0] * np.where(kept, 1.0, 0.0)[:, None]
        joint = joint_table(joints)[0]
        return np.array([transmission_kernel(a, flank, 0.0, orders, rows, joint) for a in angle])

    np.testing.assert_allclose(ripple(-1, low), ripple(1, low))
    assert abs(np.corrcoef(ripple(-1, ~low), ripple(1, ~low))[0, 1]) < 0.98
    lines = np.abs(np.fft.rfft(ripple(1, orders == 200) * np.hanning(400)))
    assert np.argmax(lines[1:]) + 1 == pytest.approx(200 * 0.2 / (2 * np.pi), abs=1)


def test_gear_ripple_swells_with_load_and_once_a_turn() -> None:
    joints = PARAMETERS.joints
    row = joint_table(joints)[0]
    orders = np.array([200.0])
    waves = np.array([[1.0, 0.0, 0.0]])
    peak = np.pi / 400.0

    def height(turned: float, load_nm: float) -> float:
        angle = turned + np.linspace(0.0, 4.0 * peak, 200)
        return max(abs(transmission_kernel(a, 1.0, load_nm, orders, waves, row)) for a in angle)

    assert height(np.pi, 0.0) / height(0.0, 0.0) == pytest.approx(
        (1.0 - joints.flexspline_1) / (1.0 + joints.flexspline_1), rel=0.02
    )
    assert height(0.0, 1e4) / height(0.0, 0.0) == pytest.approx(1.0 + joints.load_1, rel=0.01)


def test_wind_up_is_soft_about_zero() -> None:
    joints = PARAMETERS.joints
    row = joint_table(joints)[1]
    slope = wind_up_kernel(0.1, row) / 0.1
    assert slope == pytest.approx(row[COMPLIANCE] * (1.0 + joints.soft_1), rel=1e-3)
    far = (wind_up_kernel(1001.0, row) - wind_up_kernel(1000.0, row)) / 1.0
    assert far == pytest.approx(row[COMPLIANCE], rel=1e-6)


def test_a_long_arm_swings_slowly() -> None:
    modes, counts = mode_table(PARAMETERS.structure)[:1], []
    for reach in (REACH_MM, 4.0 * REACH_MM):
        state, seen = np.array([1.0, 0.0]), []
        for _ in range(1000):
            tcp = np.zeros(3)
            modes_kernel(modes, TICK_S, 0.0, reach, np.zeros(3), np.zeros(3), state, tcp, np.zeros(3))
            seen.append(tcp[0])
        counts.append(np.count_nonzero(np.diff(np.sign(seen))))
    assert counts[0] / counts[1] == pytest.approx(4.0**PARAMETERS.structure.posture_1, rel=0.06)


def test_stretched_arm_has_the_textbook_torque() -> None:
    torque = np.zeros(6)
    gravity_torque_kernel(np.zeros(6), UR10E.dh, np.array([10.0, 4.0, 6.0]), torque)
    wanted = -9.80665 * (10 * 0.5 * 0.6127 + 4 * (0.6127 + 0.5 * 0.57155) + 6 * 1.18425)
    assert torque[1] == pytest.approx(wanted)
    assert np.count_nonzero(torque) == 2


def test_mode_rings_at_its_damped_frequency_and_settles_at_the_static_bend() -> None:
    modes = mode_table(PARAMETERS.structure)[:1]
    state, history = np.zeros(2), []
    shape = modes[0, _SHAPE : _SHAPE + 3]
    for _ in range(5000):
        tcp, flange = np.zeros(3), np.zeros(3)
        modes_kernel(modes, TICK_S, 0.0, REACH_MM, shape * 100.0, np.zeros(3), state, tcp, flange)
        history.append(tcp @ shape)
    bend = np.array(history)
    omega = 2 * np.pi * PARAMETERS.structure.frequency_hz[0]
    assert bend[-1] == pytest.approx(-PARAMETERS.structure.participation[0] * 100 / omega**2)
    ringing = bend[:1000] - bend[-1]
    crossings = np.flatnonzero(np.diff(np.sign(ringing)) != 0)
    zeta = PARAMETERS.structure.damping_ratio[0]
    half_period_s = np.diff(crossings)[:10].mean() * TICK_S
    assert 0.5 / half_period_s == pytest.approx(9.4 * np.sqrt(1 - zeta**2), rel=0.01)
    peaks = [np.abs(ringing[a:b]).max() for a, b in pairwise(crossings[:7])]
    decay = np.exp(-zeta * np.pi / np.sqrt(1 - zeta**2))
    np.testing.assert_allclose(np.array(peaks[1:]) / peaks[:-1], decay, rtol=0.02)


def test_mode_shape_turns_with_joint_1() -> None:
    modes = mode_table(PARAMETERS.structure)[:1]
    moved = []
    for angle, push in ((0.0, [1.0, 0.0, 0.0]), (np.pi / 2, [0.0, 1.0, 0.0])):
        tcp = np.zeros(3)
        modes_kernel(modes, TICK_S, angle, REACH_MM, np.array(push), np.zeros(3), np.zeros(2), tcp, np.zeros(3))
        moved.append(tcp)
    np.testing.assert_allclose(moved[1], [-moved[0][1], moved[0][0], moved[0][2]], atol=1e-18)


def test_coupling_is_three_decibels_down_at_its_corner_and_blocks_gravity() -> None:
    rate = 1651.6129
    t = np.arange(int(40 * rate)) / rate
    signal = np.column_stack([np.sin(np.pi * t), np.sin(100 * np.pi * t), np.ones(len(t))])
    _couple_kernel(signal, 0.5, rate)
    late = signal[len(t) // 2 :]
    assert late[:, 0].std() == pytest.approx(0.5, rel=0.01)
    assert late[:, 1].std() == pytest.approx(np.sqrt(0.5), rel=0.01)
    assert np.abs(late[:, 2]).max() < 1e-12


def test_resampling_follows_a_smooth_signal() -> None:
    t = np.arange(1000) / 500
    at = np.linspace(0.01, 1.9, 777)
    out = np.empty((777, 1))
    _resample_kernel(np.sin(2 * np.pi * 9.4 * t)[:, None], 500.0, at, out)
    np.testing.assert_allclose(out[:, 0], np.sin(2 * np.pi * 9.4 * at), atol=1e-4)


def test_accelerometer_sees_a_known_shake_with_its_noise_and_limits() -> None:
    quiet = replace(PARAMETERS.accelerometers, base_floor_ug=0.0, base_line_ug=0.0)
    t = np.arange(10_000) / 500
    shake_mm = 0.1 * np.sin(2 * np.pi * 9.4 * t)
    path = np.column_stack([shake_mm, np.zeros((len(t), 2))])
    upright = np.tile(np.eye(3).ravel(), (len(t), 1))
    eye = (np.eye(3), np.eye(3))
    group = accelerometer_group(quiet, eye, 0.03, (path, upright, 500.0), 0.1, 0.0, np.random.default_rng(0))
    peak_g = 0.1 * (2 * np.pi * 9.4) ** 2 / 9806.65
    wrist = group.columns["wrist_x_g"]
    assert wrist.std() == pytest.approx(peak_g / np.sqrt(2), rel=0.02)
    assert group.columns["base_x_g"].std() == pytest.approx(0.03 * wrist.std(), rel=0.1)
    assert group.columns["wrist_y_g"].std() == pytest.approx(50e-6, rel=0.05)
    assert group.rate_hz == pytest.approx(51200 / 31)
    violent = (2000 * path, upright, 500.0)
    clipped = accelerometer_group(quiet, eye, 0.03, violent, 0.1, 0.0, np.random.default_rng(0))
    assert np.abs(clipped.columns["wrist_x_g"]).max() == 5.0


def test_ball_bar_measures_length_in_quanta_on_its_own_clock() -> None:
    bar = PARAMETERS.ballbar
    t = np.arange(2000) / 500
    tool = np.column_stack([100 + 0.05 * np.sin(t), np.zeros((2000, 2))])
    got = read_ballbar(bar, tool, 500.0, np.zeros(3), 100.0, (0.25, 500.0, 400), np.zeros(400))
    at = 0.25 + np.arange(400) / 200 / (1 + 5e-4)
    np.testing.assert_allclose(got, 0.05 * np.sin(at), atol=0.6e-4)
    np.testing.assert_allclose(got * 1e4, np.round(got * 1e4), atol=1e-6)


def test_drift_has_the_stated_size_and_correlation_time() -> None:
    noise = np.random.default_rng(0).standard_normal((400_000, 1))
    drift_kernel(noise, 7.0, 0.2, TICK_S)
    drift = noise[:, 0]
    assert drift.std() == pytest.approx(7.0, rel=0.05)
    lag = np.corrcoef(drift[:-100], drift[100:])[0, 1]
    assert lag == pytest.approx(np.exp(-1), abs=0.05)


def test_parameter_file_with_an_unknown_name_is_refused(tmp_path) -> None:  # type: ignore[no-untyped-def]
    broken = tmp_path / "machine.toml"
    broken.write_text("[motion]\nacceleration = 3\n")
    with pytest.raises(InputError) as caught:
        load_parameters(broken)
    assert caught.value.code == "machine.parameters"
