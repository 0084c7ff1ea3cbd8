"""The split of a measured circle: closed forms, and a mill whose encoder sits at the motor."""

from __future__ import annotations

import numpy as np
import pytest

from dtwin.errors import InputError
from dtwin.features.encoder_split import Cutoff, _repeat_floor, seen_by_controller_um, slow_part, split
from dtwin.machines.mill import SetupErrors, VirtualMill
from dtwin.machines.mill_parameters import CircularTest, MillParameters, NoiseParameters
from dtwin.schema import RunMeta

THETA = np.radians(np.arange(360) + 0.5)
FULL = np.ones(360, dtype=bool)
META = RunMeta("r1", plane="XY", direction="CCW", radius_mm=100.0, feed_mm_min=2000.0)


def test_a_following_error_is_projected_on_the_outward_radius() -> None:
    angle = np.degrees(THETA)
    x, y = 100.0 * np.cos(THETA), 100.0 * np.sin(THETA)
    samples = {"cmd_x_mm": x, "act_x_mm": x - 0.003 * np.sin(THETA), "cmd_y_mm": y, "act_y_mm": y + 0.001}
    seen = seen_by_controller_um(META, samples, angle)
    # -3 sin cos + 1 sin, by hand.
    np.testing.assert_allclose(seen, -1.5 * np.sin(2 * THETA) + np.sin(THETA), atol=1e-9)
    assert seen_by_controller_um(META, {"deviation_um": x}, angle) is None
    assert seen_by_controller_um(META, {"cmd_x_mm": x, "act_x_mm": x}, angle) is None


def test_the_plane_decides_which_axes_count() -> None:
    other = RunMeta("r1", plane="ZX", direction="CCW", radius_mm=50.0, feed_mm_min=2000.0)
    zero = np.zeros(360)
    samples = {"cmd_z_mm": zero, "act_z_mm": zero + 0.002, "cmd_x_mm": zero, "act_x_mm": zero}
    seen = seen_by_controller_um(other, samples, np.degrees(THETA))
    np.testing.assert_allclose(seen, 2.0 * np.cos(THETA), atol=1e-9)


def test_harmonics_of_a_turn_are_cut_exactly() -> None:
    slow, fast = 2.0 * np.cos(5 * THETA + 0.4) + 1.0, 0.7 * np.sin(16 * THETA)
    np.testing.assert_allclose(slow_part(slow + fast, FULL, 15.0), slow, atol=1e-12)
    np.testing.assert_allclose(slow_part(slow + fast, FULL, 16.0), slow + fast, atol=1e-12)


@pytest.mark.parametrize("start", [0, 100, 300])
def test_an_arc_is_cut_at_its_half_cycles_wherever_it_begins(start: int) -> None:
    n = 180
    inside = (np.arange(n) + 0.5) / n
    slow, fast = 3.0 * np.cos(7 * np.pi * inside) - 2.0, np.cos(40 * np.pi * inside)
    places = (start + np.arange(n)) % 360
    known, values = np.zeros(360, dtype=bool), np.zeros(360)
    known[places], values[places] = True, slow + fast
    # 7 half cycles of a half turn are 7 cycles per revolution; 40 are 40.
    found = slow_part(values, known, 20.0)
    np.testing.assert_allclose(found[places], slow, atol=1e-12)
    assert not found[~known].any()
    assert np.abs(slow_part(values, known, 6.9)[places] + 2.0).max() < 1e-12


def test_a_short_hole_in_an_arc_is_bridged() -> None:
    known = np.zeros(360, dtype=bool)
    known[:200] = True
    known[50:53] = False
    found = slow_part(np.where(known, 4.0, 0.0), known, 3.0)
    np.testing.assert_allclose(found[known], 4.0)
    assert not found[50:53].any()


def test_the_parts_add_up_and_their_sizes_are_those_of_their_waves() -> None:
    rng = np.random.default_rng(0)
    controller = np.tile(4.0 * np.cos(2 * THETA), (6, 1))
    shape = 3.0 * np.sin(3 * THETA) + 2.0 * np.cos(40 * THETA)
    offsets = rng.standard_normal(6)
    measured = controller + shape + offsets[:, None] * np.sin(5 * THETA)
    known, conditions = np.ones((6, 360), dtype=bool), np.array([0, 0, 0, 1, 1, 1])
    found = split(measured, controller, known, conditions, np.full(6, 15.0))
    parts = found.parts_um
    np.testing.assert_allclose(parts["controller"] + parts["quasi_static"] + parts["dynamic"], measured, atol=1e-12)
    sizes = found.sizes()
    assert sizes["controller"].rms_um == pytest.approx(4.0 / np.sqrt(2.0))
    assert sizes["dynamic"].rms_um == pytest.approx(2.0 / np.sqrt(2.0))
    # Repeats differ by a slow wave only: its pooled spread is the floor of the slow part.
    spread = np.sqrt(np.mean([offsets[:3].var(ddof=1), offsets[3:].var(ddof=1)]) / 2.0)
    assert sizes["quasi_static"].floor_um == pytest.approx(spread)
    assert sizes["dynamic"].floor_um == pytest.approx(0.0, abs=1e-9)
    assert found.seen_unseen_correlation(conditions == 0) == pytest.approx(0.0, abs=1e-9)


def test_without_repeats_there_is_no_floor() -> None:
    assert np.isnan(_repeat_floor(np.zeros((2, 360)), np.ones((2, 360), bool), np.array([0, 1])))


def test_a_split_is_declared_once_and_hertz_depend_on_the_condition() -> None:
    # Radius 1 mm, 2 pi mm in a second: one turn a second, a wave a second is one a turn.
    assert Cutoff(hz=8.0).cycles(1.0, 2.0 * np.pi * 60.0) == pytest.approx(8.0)
    assert Cutoff(cycles_per_rev=8.0).cycles(1.0, 99.0) == 8.0
    for wrong in ({}, {"hz": 1.0, "cycles_per_rev": 2.0}, {"hz": -1.0}, {"hz": float("nan")}):
        with pytest.raises(InputError, match="split at one frequency"):
            Cutoff(**wrong)


def _controller_and_bar(mill: MillParameters) -> tuple[np.ndarray, np.ndarray]:
    quiet, centred = NoiseParameters(rms_um=0.0), SetupErrors(0.0, 0.0, 0.0, 0.0)
    (run,) = VirtualMill(mill, 0, quiet, centred).measure([CircularTest(feed_mm_min=3000.0)])
    seen = seen_by_controller_um(run.meta, run.samples, run.samples["angle_deg"])
    assert seen is not None
    return seen, run.samples["deviation_um"]


def test_a_motor_encoder_sees_the_servo_and_nothing_behind_the_screw() -> None:
    lagging = MillParameters().with_axis("X", feed_forward=0.98)
    seen, bar = _controller_and_bar(lagging)
    # All of the error is in the loop: the encoder sees what the bar measures, to second order.
    assert np.abs(bar).max() > 5.0
    np.testing.assert_allclose(seen, bar, atol=2e-2)

    loose = MillParameters(squareness_um_m={"XY": 40.0}).with_axis("Y", play_um=6.0, scale_ppm=50.0)
    seen, bar = _controller_and_bar(loose)
    assert np.abs(bar).max() > 5.0
    assert np.abs(seen).max() < 1e-6
