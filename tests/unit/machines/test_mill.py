"""The virtual mill: exact without faults, and each mechanism where mechanics puts it."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from dtwin.errors import InputError
from dtwin.machines.mill import Moment, SetupErrors, VirtualMill
from dtwin.machines.mill_parameters import CircularTest, MillParameters, NoiseParameters

IDEAL = MillParameters()
QUIET = NoiseParameters(rms_um=0.0)
CENTRED = SetupErrors(centre_mm=0.0, radius_um=0.0, jitter_us=0.0, trigger_samples=0.0)


def _measured(parameters, *tests):
    runs = VirtualMill(parameters, 0, QUIET, CENTRED).measure(tests or [CircularTest()])
    return [(run.samples["angle_deg"] % 360.0, run.samples["deviation_um"]) for run in runs]


def test_a_machine_without_faults_drives_a_circle():
    ((_, deviation_um),) = _measured(IDEAL)
    assert np.abs(deviation_um).max() < 1e-6


def test_lost_motion_steps_where_its_axis_turns_round_and_changes_sign_with_direction():
    mill = IDEAL.with_axis("X", play_um=6.0)
    (angle, ccw), (back, cw) = _measured(mill, CircularTest(), CircularTest(direction="CW"))
    for degrees, y, sign in ((angle, ccw, 1.0), (back, cw, -1.0)):
        after = y[(degrees > 6.0) & (degrees < 10.0)].mean()
        before = y[(degrees > 350.0) & (degrees < 354.0)].mean()
        assert sign * after == pytest.approx(3.0, abs=0.1)
        assert sign * before == pytest.approx(-3.0, abs=0.1)


def test_squareness_stretches_a_diagonal_and_a_servo_lag_does_so_by_direction():
    tests = [CircularTest(direction=d) for d in ("CCW", "CW")]
    lean = _measured(replace(IDEAL, squareness_um_m={"XY": 50.0}), *tests)
    lag = _measured(IDEAL.with_axis("X", feed_forward=0.99), *tests)
    at_45 = [[np.interp(45.0, *_sorted(run)) for run in runs] for runs in (lean, lag)]
    assert at_45[0][0] == pytest.approx(at_45[0][1], rel=0.02)
    assert at_45[1][0] == pytest.approx(-at_45[1][1], rel=0.05)


def test_friction_spikes_after_reversal_and_grows_with_feed():
    mill = IDEAL.with_axis("X", friction_mm_s2=100.0, integral_time_ms=20.0)
    runs = _measured(mill, *[CircularTest(feed_mm_min=f) for f in (500.0, 1000.0, 4000.0)])
    heights = [np.abs(y).max() for _, y in runs]
    assert heights[0] < heights[1] < heights[2]
    angle, y = runs[1]
    assert min(angle[np.argmax(np.abs(y))] % 180.0, 180.0 - angle[np.argmax(np.abs(y))] % 180.0) < 8


def test_a_screw_error_stays_where_it_is_at_any_feed():
    mill = IDEAL.with_axis("X", pitch_error_um=2.0, pitch_mm=12.0)
    (_, slow), (_, fast) = _measured(mill, *[CircularTest(feed_mm_min=f) for f in (1000.0, 4000.0)])
    assert np.corrcoef(slow, fast)[0, 1] > 0.999


def test_a_warm_machine_grows_and_shrinks_again_while_it_stands():
    mill = IDEAL.with_axis("X", growth_um_m_k=11.0)
    tests = [CircularTest(repeat=n + 1, pause_s=7200.0 if n == 20 else 0.0) for n in range(21)]
    runs = VirtualMill(mill, 0, QUIET, CENTRED).measure(tests)
    peak = [float(run.samples["deviation_um"].max()) for run in runs]
    logged = [run.meta.covariates["temperature_c"] for run in runs]
    assert all(a < b for a, b in itertools.pairwise(peak[:20]))
    assert peak[20] < 0.2 * peak[19]
    assert np.corrcoef(peak, logged)[0, 1] > 0.99


def test_a_ringing_mode_is_struck_at_reversals_only():
    mill = IDEAL.with_axis("X", breakaway_mm=0.001, mode_hz=25.0)
    ((angle, y),) = _measured(mill, CircularTest(feed_mm_min=4000.0))
    from_x = np.minimum(angle % 180.0, 180.0 - angle % 180.0)
    assert np.abs(y[from_x < 20.0]).max() > 20.0 * np.abs(y[from_x > 80.0]).max()


def test_repeats_share_the_mechanism_and_differ_in_noise():
    tests = [CircularTest(repeat=n) for n in (1, 2)]
    first, second = VirtualMill(IDEAL, 5, setup_errors=CENTRED).measure(tests)
    apart = first.samples["deviation_um"] - second.samples["deviation_um"]
    assert 0.3 < np.std(apart) / np.sqrt(2.0) < 1.2
    again, _ = VirtualMill(IDEAL, 5, setup_errors=CENTRED).measure(tests)
    assert np.array_equal(first.samples["deviation_um"], again.samples["deviation_um"])


def test_a_disturbance_of_ones_own_is_added():
    def lobe(moment: Moment):
        return 3.0 * np.cos(5.0 * moment.angle_rad)

    runs = VirtualMill(IDEAL, 0, QUIET, CENTRED, lobe).measure([CircularTest()])
    assert np.std(runs[0].samples["deviation_um"]) == pytest.approx(3.0 / np.sqrt(2.0), rel=0.01)


def test_what_it_cannot_drive_is_refused():
    with pytest.raises(InputError):
        CircularTest(radius_mm=0.0)
    with pytest.raises(InputError):
        NoiseParameters(kind="pink")


def _sorted(run):
    order = np.argsort(run[0])
    return run[0][order], run[1][order]
