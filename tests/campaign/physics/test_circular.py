from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dtwin.acquire.b5r import read_b5r
from dtwin.errors import InputError
from dtwin.physics.circular import _minimum_zone_um, bidirectional_figures, circular_figures, fit_circle
from dtwin.physics.spectrum import _band_rms_um, strongest_lines

ANGLE = np.arange(0.0, 360.0, 0.25)
THETA = np.radians(ANGLE)


def _eccentric(a_um: float, b_um: float, dr_um: float, radius_mm: float) -> np.ndarray:
    """Exact distance from the origin to a circle that is off centre (law of cosines)."""
    r = radius_mm * 1000 + dr_um
    along = a_um * np.cos(THETA) + b_um * np.sin(THETA)
    across = a_um * np.sin(THETA) - b_um * np.cos(THETA)
    return along + np.sqrt(r**2 - across**2) - radius_mm * 1000


@given(
    a=st.floats(-500, 500),
    b=st.floats(-500, 500),
    dr=st.floats(-200, 200),
    radius=st.sampled_from([50.0, 100.0, 300.0]),
)
def test_an_exact_circle_is_found_exactly(a: float, b: float, dr: float, radius: float) -> None:
    circle = fit_circle(ANGLE, _eccentric(a, b, dr, radius), radius)
    assert circle.centre_a_um == pytest.approx(a, abs=1e-5)
    assert circle.centre_b_um == pytest.approx(b, abs=1e-5)
    assert circle.radius_change_um == pytest.approx(dr, abs=1e-5)
    figures = circular_figures(ANGLE, _eccentric(a, b, dr, radius), radius)
    assert figures.circular_deviation_um < 1e-4


@given(amplitude=st.floats(0.1, 100), order=st.integers(2, 12), phase=st.floats(0, 6.28))
def test_a_lobed_circle_has_twice_its_amplitude(amplitude: float, order: int, phase: float) -> None:
    deviation = amplitude * np.cos(order * THETA + phase)
    figures = circular_figures(ANGLE, deviation, 100.0)
    assert figures.circular_deviation_um == pytest.approx(2 * amplitude, rel=2e-3)
    assert figures.rms_um == pytest.approx(amplitude / np.sqrt(2), rel=1e-3)
    assert figures.mean_absolute_um == pytest.approx(2 * amplitude / np.pi, rel=2e-3)
    assert figures.circular_deviation_mz_um <= figures.circular_deviation_um + 1e-6


def test_minimum_zone_of_a_bump_is_narrower_than_least_squares() -> None:
    bump = np.where((ANGLE > 80) & (ANGLE < 100), 10.0, 0.0)
    width, a_um, b_um = _minimum_zone_um(ANGLE, bump)
    figures = circular_figures(ANGLE, bump, 100.0)
    rest = bump - a_um * np.cos(THETA) - b_um * np.sin(THETA)
    assert width == pytest.approx(np.ptp(rest), abs=1e-6)
    assert width < figures.circular_deviation_um


def test_a_partial_arc_still_finds_its_centre() -> None:
    half = ANGLE <= 190
    circle = fit_circle(ANGLE[half], _eccentric(60, -40, 5, 150.0)[half], 150.0)
    assert circle.eccentricity_um == pytest.approx(np.hypot(60, 40), abs=1e-4)


@pytest.mark.filterwarnings("error")
def test_a_spoilt_reading_far_off_any_machine_prints_no_warning() -> None:
    deviation_um = np.zeros(360)
    deviation_um[10] = -1e9
    assert np.isfinite(fit_circle(np.arange(360.0), deviation_um, 100.0).radius_mm)


def test_too_short_an_arc_is_refused() -> None:
    with pytest.raises(InputError, match="arc is too short"):
        fit_circle(ANGLE[:100], np.zeros(100), 100.0)


def test_hysteresis_is_the_largest_difference_of_samples_at_one_angle() -> None:
    nothing = (-ANGLE, np.zeros_like(ANGLE))
    step = 8.0 * np.sign(np.sin(THETA)) * np.cos(THETA)
    figures = bidirectional_figures((ANGLE, step), nothing, 100.0)
    assert figures.hysteresis_um == pytest.approx(8.0, rel=0.01)
    # A spike of one sample is not averaged away, and is found at its angle.
    spike = np.zeros_like(ANGLE)
    spike[ANGLE.size // 3] = 30.0
    figures = bidirectional_figures((ANGLE, spike), nothing, 100.0)
    assert figures.hysteresis_um == pytest.approx(30.0, rel=0.01)
    assert figures.hysteresis_angle_deg == pytest.approx(ANGLE[ANGLE.size // 3] % 360.0)
    both = bidirectional_figures((ANGLE, np.full_like(ANGLE, 3.0)), (-ANGLE, np.ones_like(ANGLE)), 100.0)
    assert both.mean_bidirectional_radius_um == pytest.approx(2.0, abs=1e-6)
    assert both.hysteresis_um == pytest.approx(2.0, abs=1e-6)


def test_directions_whose_arcs_only_touch_have_no_radius_together() -> None:
    arc = np.linspace(0.0, 38.2, 400)
    with pytest.raises(InputError, match="no angle in common"):
        bidirectional_figures((arc, np.zeros(400)), (-arc, np.zeros(400)), 100.0)


def test_noise_adds_to_hysteresis_as_it_is_documented() -> None:
    noise = np.random.default_rng(0).normal(0.0, 0.5, (2, ANGLE.size))
    found = bidirectional_figures((ANGLE, noise[0]), (-ANGLE, noise[1]), 100.0).hysteresis_um
    assert found == pytest.approx(0.5 * np.sqrt(2.0) * np.sqrt(2.0 * np.log(ANGLE.size)), rel=0.2)


def test_where_one_direction_was_not_measured_there_is_no_hysteresis() -> None:
    part = ANGLE < 300.0
    lump = np.where(ANGLE > 310.0, 50.0, 0.0)
    figures = bidirectional_figures((ANGLE, lump), (ANGLE[part][::-1], np.zeros(part.sum())), 100.0)
    assert figures.hysteresis_um < 1.0
    with pytest.raises(InputError, match="no angle in common"):
        bidirectional_figures((ANGLE[:400], lump[:400]), (ANGLE[600:], lump[600:]), 100.0)


def test_common_and_own_centres_differ_by_what_the_centres_are_apart() -> None:
    ccw, cw = (ANGLE, _eccentric(10, 0, 0, 100.0)), (-ANGLE, np.zeros_like(ANGLE))
    figures = bidirectional_figures(ccw, cw, 100.0)
    assert figures.circular_deviation_own_centres_um == pytest.approx(0.0, abs=1e-3)
    assert figures.circular_deviation_common_centre_um == pytest.approx(10.0, rel=0.01)
    assert figures.hysteresis_um == pytest.approx(10.0, rel=0.01)


def test_real_file_agrees_with_the_vendor_within_0_3_um(real_recording: Path) -> None:
    for run in read_b5r(real_recording).runs:
        window = slice(*run.window)
        figures = circular_figures(run.samples["angle_deg"][window], run.samples["deviation_um"][window], 100.0)
        stated = run.meta.vendor
        assert figures.circle.centre_a_um == pytest.approx(stated["centre_a_um"], abs=0.3)
        assert figures.circle.centre_b_um == pytest.approx(stated["centre_b_um"], abs=0.3)
        assert figures.circle.radius_mm == pytest.approx(stated["best_radius_mm"], abs=0.3e-3)
        assert figures.circular_deviation_um == pytest.approx(stated["circularity_um"], abs=0.3)


def test_bands_add_up_and_a_line_is_found() -> None:
    t = np.arange(0, 8, 1 / 200)
    rng = np.random.default_rng(3)
    signal = 15.0 * np.cos(2 * np.pi * 9.43 * t + 1.0) + rng.normal(0, 2, t.size)
    lines, bands = strongest_lines(signal, 200.0)
    assert lines[0][0] == pytest.approx(9.43, abs=0.02)
    assert lines[0][1] == pytest.approx(15.0, rel=0.05)
    assert sum(rms**2 for *_, rms in bands) == pytest.approx(np.var(signal), rel=1e-6)
    inside = {(low, high): rms for low, high, rms in _band_rms_um(signal, 200.0)}
    assert inside[(8.0, 12.0)] == pytest.approx(15 / np.sqrt(2), rel=0.05)


@pytest.mark.parametrize("turns", [0.3, 1.0, 2.5])
def test_the_minimum_zone_of_many_samples_is_that_of_all_of_them(turns: float) -> None:
    rng = np.random.default_rng(0)
    angle = np.linspace(-90.0, 360.0 * turns, 20_000)
    deviation = (
        30.0 * np.cos(np.radians(angle) - 0.3)
        + 5.0 * np.cos(np.radians(2.0 * angle))
        + rng.normal(0.0, 1.0, angle.size)
    )
    width, a, b = _minimum_zone_um(angle, deviation)
    rest = deviation - a * np.cos(np.radians(angle)) - b * np.sin(np.radians(angle))
    assert np.ptp(rest) == pytest.approx(width, abs=1e-4)
    # No centre near it does better; the width is convex in the centre.
    for step in (0.01, 0.1):
        for turn in np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False):
            moved = (
                rest - step * np.cos(turn) * np.cos(np.radians(angle)) - step * np.sin(turn) * np.sin(np.radians(angle))
            )
            assert np.ptp(moved) >= width - 1e-4


@pytest.mark.parametrize(
    "angle",
    [
        np.linspace(0.0, 360.0, 8000, endpoint=False)
        - 0.9 * np.degrees(np.sin(4.0 * np.radians(np.linspace(0.0, 360.0, 8000, endpoint=False)))) / 4.0,
        np.sort(np.concatenate([ANGLE, np.arange(40.0, 80.0, 0.01)])),
        np.concatenate([np.zeros(3000), ANGLE]),
        np.arange(0.0, 540.0, 0.25),
    ],
    ids=["slows near reversals", "a dense arc", "stands", "one and a half turns"],
)
def test_figures_do_not_depend_on_how_densely_a_circle_was_sampled(angle: np.ndarray) -> None:
    def deviation(angle: np.ndarray) -> np.ndarray:
        theta = np.radians(angle)
        return 3.0 * np.cos(theta) + 5.0 * np.cos(2.0 * theta) + 4.0 * np.sign(np.sin(theta)) * np.cos(theta)

    even = circular_figures(ANGLE, deviation(ANGLE), 100.0)
    found = circular_figures(angle, deviation(angle), 100.0)
    assert found.circular_deviation_um == pytest.approx(even.circular_deviation_um, abs=0.02)
    assert found.rms_um == pytest.approx(even.rms_um, abs=0.02)
    assert found.circle.centre_a_um == pytest.approx(even.circle.centre_a_um, abs=0.02)
    # Nor is a centre of both directions that of the one with more samples.
    both = bidirectional_figures((angle, deviation(angle)), (-ANGLE, np.zeros_like(ANGLE)), 100.0)
    alike = bidirectional_figures((ANGLE, deviation(ANGLE)), (-ANGLE, np.zeros_like(ANGLE)), 100.0)
    assert both.circular_deviation_common_centre_um == pytest.approx(
        alike.circular_deviation_common_centre_um, abs=0.02
    )
    assert both.mean_bidirectional_radius_um == pytest.approx(alike.mean_bidirectional_radius_um, abs=0.02)


def test_even_samples_of_an_arc_count_alike() -> None:
    arc = ANGLE < 200.0
    theta, deviation = THETA[arc], 5.0 * np.cos(3.0 * THETA[arc])
    plain = np.linalg.lstsq(np.column_stack([np.cos(theta), np.sin(theta), np.ones_like(theta)]), deviation)[0]
    circle = fit_circle(ANGLE[arc], deviation, 1e6)
    assert (circle.centre_a_um, circle.centre_b_um, circle.radius_change_um) == pytest.approx(plain, abs=1e-5)


def test_a_coarse_table_of_both_directions_has_a_hysteresis_and_no_more_where_readings_lack() -> None:
    coarse = np.arange(0.0, 360.0, 10.0)
    up, down = (coarse, np.full(36, 4.0)), (coarse, np.zeros(36))
    figures = bidirectional_figures(up, down, 100.0)
    assert figures.hysteresis_um == pytest.approx(4.0)
    assert figures.mean_bidirectional_radius_um == pytest.approx(2.0)
    high = np.where((coarse > 90.0) & (coarse < 130.0), 50.0, 0.0)
    part = (coarse < 90.0) | (coarse > 130.0)
    figures = bidirectional_figures((coarse, high), (coarse[part], np.zeros(part.sum())), 100.0)
    assert figures.hysteresis_um < 1.0
