"""The ultra-precision mill: what is published of it comes out, and its sensors are blind to it."""

from __future__ import annotations

import numpy as np
import pytest

from dtwin.errors import InputError
from dtwin.machines.mill import SetupErrors, VirtualMill
from dtwin.machines.mill_drive import STEP_S
from dtwin.machines.mill_parameters import CircularTest, NoiseParameters
from studies.machines.hybrid_mill import ITEMS, MODE_HZ, SENSOR_NOISE_G, CorrectionInput, HybridMill, hybrid_parameters

CORNERS = np.array([[0.0, 47.0], [47.0, 47.0], [47.0, 0.0]])


def test_circles_show_the_published_slow_error_and_servo_error() -> None:
    mill = VirtualMill(
        hybrid_parameters(),
        seed=1,
        noise=NoiseParameters(rms_um=0.2),
        setup_errors=SetupErrors(centre_mm=0.002, radius_um=0.5),
    )
    tests = [CircularTest(radius_mm=50.0, feed_mm_min=f) for f in (100.0, 250.0, 500.0)]
    servo = []
    for run in mill.measure(tests):
        assert 6.0 <= float(np.abs(run.samples["deviation_um"]).mean()) <= 8.0
        lag = run.samples["act_x_mm"] - run.samples["cmd_x_mm"]
        servo.append(1e3 * float(np.abs(lag).mean()))
    assert 0.01 < servo[0] < servo[1] < servo[2] < 0.2


def test_the_room_goes_from_16_to_21_degrees_and_lengths_follow() -> None:
    heat = hybrid_parameters().heat
    room = [heat.room_at_c(t) for t in np.linspace(0.0, 24.0, 200)]
    assert (min(room), max(room)) == pytest.approx((16.0, 21.0), abs=0.01)
    runs = {}
    for hour in (3.0, 9.0):
        mill = HybridMill(0, time_s=3600.0 * hour)
        runs[hour] = mill.run(CORNERS, 500.0)
    assert runs[3.0].temperature_c - runs[9.0].temperature_c == pytest.approx(5.0, abs=0.01)
    grown = runs[3.0].error_um[0, -1] - runs[9.0].error_um[0, -1]
    assert grown == pytest.approx(47.0 * 11.5e-3 * 5.0, rel=0.01)


def test_the_table_turns_the_set_up_and_the_mode_rings_at_194_hz() -> None:
    mill = HybridMill(3)
    shift = [mill.run(CORNERS, 500.0, c_deg=c).error_um[:, 0] for c in (0.0, 180.0)]
    np.testing.assert_allclose(shift[1] - shift[0], 2.0 * mill.mounting_um(), atol=0.01)
    assert {hybrid_parameters().axis(a).mode_hz for a in "XY"} == {MODE_HZ} == {194.0}


def test_the_accelerometers_cannot_see_the_slow_error() -> None:
    run = HybridMill(0).run(CORNERS, 500.0)
    moving = np.abs(run.items["VelocityFeedbackAverage"]).max(axis=0) > 8.3
    slow = np.gradient(np.gradient(run.error_um / 1e3, STEP_S, axis=1), STEP_S, axis=1) / 9806.65
    steady = np.convolve(moving, np.ones(3601), "same") > 3600.5
    # Long after the ramps, whose step the corner of the sensors remembers for a second.
    assert np.ptp(run.error_um[0]) > 10.0
    assert np.std(slow[:, steady]) < 0.01 * SENSOR_NOISE_G
    assert np.std(run.table_g[:, steady]) == pytest.approx(SENSOR_NOISE_G, rel=0.3)
    seen = abs(np.corrcoef(run.table_g[0, steady], run.error_um[0, steady])[0, 1])
    assert seen < 0.1


def test_the_correction_input_has_steps_delay_rate_and_ends() -> None:
    wanted = np.vstack([np.linspace(0.0, 60.0, 1000), np.full(1000, 300.0)])
    source = CorrectionInput(quantum_um=0.98, delay_s=0.02, update_hz=6.0)
    got = source.applied_um(wanted)
    assert not got[:, :20].any()
    np.testing.assert_allclose(
        got / 0.98 - np.round(got / 0.98), np.where(got == 125.0, got / 0.98 - np.round(125.0 / 0.98), 0.0), atol=1e-9
    )
    assert len(np.unique(got[0])) <= 7
    assert got.max() == 125.0
    run = HybridMill(0).run(CORNERS, 500.0)
    mill = HybridMill(0)
    n = len(mill.command(CORNERS, 500.0).phase_rad)
    shifted = mill.run(CORNERS, 500.0, wanted_um=np.full((2, n), 9.8))
    np.testing.assert_allclose((shifted.error_um - run.error_um)[:, -500:], 9.8, atol=0.05)
    np.testing.assert_allclose(shifted.analogue_v[:, -1], 5.0 + 9.8 / 25.0)
    assert set(shifted.items) == set(ITEMS)
    speed = shifted.scalars["CoordinatedSpeedTargetActual"]
    assert speed.max() == pytest.approx(500.0 / 60.0, rel=1e-6)
    assert 3000.0 * shifted.scalars["AnalogInput0"].mean() == pytest.approx(7500.0, rel=0.01)


def test_what_the_mill_cannot_drive_is_refused() -> None:
    mill = HybridMill(0)
    for corners, feed, words in ((np.array([[0.0, 0.0], [0.0, 80.0]]), 500.0, "strokes"), (CORNERS, 3500.0, "feed")):
        with pytest.raises(InputError, match=words):
            mill.run(corners, feed)
    with pytest.raises(InputError, match="does not fit"):
        mill.run(CORNERS, 500.0, wanted_um=np.zeros((2, 3)))
