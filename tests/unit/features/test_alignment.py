"""Streams with known offsets between their clocks."""

from __future__ import annotations

import numpy as np
import pytest

from dtwin.errors import InputError
from dtwin.features.alignment import align_envelopes, align_periodic, align_stops, nearest_neighbour, unwrap_angle

STOPS_S = (3.0, 7.1, 11.3, 15.2)


def bursts(rate_hz: float, shift_s: float, length_s: float = 18.0, seed: int = 0) -> np.ndarray:
    t = np.arange(int(length_s * rate_hz)) / rate_hz
    x = 2e-3 * np.random.default_rng(seed).standard_normal(len(t))
    for k, at in enumerate(STOPS_S):
        width = 0.05 + 0.02 * k
        x += (1 + 0.3 * k) * np.exp(-(((t - at - shift_s) / width) ** 2)) * np.sin(250 * t)
    return x


def commanded(rate_hz: float, length_s: float = 18.0) -> np.ndarray:
    t = np.arange(int(length_s * rate_hz)) / rate_hz
    return sum(np.where(np.abs(t - at) < 0.05 + 0.02 * k, 1000.0, 0.0) for k, at in enumerate(STOPS_S))


@pytest.mark.parametrize("lag_s", [-1.237, 0.0, 0.4445, 2.01])
def test_stops_give_the_lag_between_two_clocks(lag_s: float) -> None:
    stream = bursts(200.0, -lag_s)
    found = align_stops(stream, 200.0, commanded(500.0), 500.0, max_lag_s=3.0)
    assert found.lag_s == pytest.approx(lag_s, abs=0.02)
    assert found.sharpness > 0.1


def test_equal_spacing_is_reported_as_less_sharp() -> None:
    t = np.arange(0, 18, 0.005)
    regular = sum(np.exp(-(((t - at) / 0.1) ** 2)) for at in (3, 7, 11, 15))
    irregular = sum(np.exp(-(((t - at) / 0.1) ** 2)) for at in STOPS_S)
    same = align_envelopes(regular, 200.0, regular, 200.0, max_lag_s=5.0)
    other = align_envelopes(irregular, 200.0, irregular, 200.0, max_lag_s=5.0)
    assert same.sharpness < 0.3 < other.sharpness


def test_lag_is_finer_than_a_sample() -> None:
    t = np.arange(0, 10, 0.01)
    shape = np.exp(-(((t - 4) / 0.3) ** 2)) + 0.5 * np.exp(-(((t - 6.2) / 0.2) ** 2))
    moved = np.interp(t + 0.0037, t, shape)
    found = align_envelopes(moved, 100.0, shape, 100.0, max_lag_s=1.0)
    assert found.lag_s == pytest.approx(0.0037, abs=5e-4)
    assert found.residual < 0.02


def test_unrelated_records_have_a_large_residual() -> None:
    rng = np.random.default_rng(1)
    found = align_envelopes(rng.standard_normal(2000), 200.0, rng.standard_normal(2000), 200.0, max_lag_s=2.0)
    assert found.residual > 1.2
    assert found.sharpness < 0.1


def test_no_overlap_is_refused() -> None:
    with pytest.raises(InputError, match="in common"):
        align_envelopes(np.ones(100), 100.0, np.ones(100), 100.0, max_lag_s=0.1, around_s=5.0)


def profile(angle: np.ndarray) -> np.ndarray:
    return np.sin(2 * angle) + 0.6 * np.cos(5 * angle + 0.4) + 0.3 * np.sin(angle)


@pytest.mark.parametrize("offset_rad", [-2.5, -0.31, 0.0, 1.0, 3.0])
def test_periodic_records_give_the_angle_between_them(offset_rad: float) -> None:
    wrapped = np.angle(np.exp(1j * np.linspace(0.3, 0.3 + 4.4 * np.pi, 3000)))
    other = np.linspace(-1.0, -1.0 + 2.2 * np.pi, 1700)
    turn, found = align_periodic(profile(wrapped + offset_rad), wrapped, profile(other), other)
    assert turn == pytest.approx(offset_rad, abs=2e-3)
    assert found.correlation > 0.999


def test_periodic_alignment_works_clockwise() -> None:
    angle = np.linspace(1.0, 1.0 - 4.4 * np.pi, 3000)
    turn, _ = align_periodic(profile(angle + 0.5), angle, profile(angle), angle)
    assert turn == pytest.approx(0.5, abs=2e-3)


def test_angles_that_cannot_be_unwrapped_are_refused() -> None:
    with pytest.raises(InputError, match="coarsely"):
        unwrap_angle(np.array([0.0, 3.0, 6.0]))
    with pytest.raises(InputError, match="less than one turn"):
        align_periodic(np.ones(50), np.linspace(0, 3, 50), np.ones(50), np.linspace(0, 7, 50))


def test_nearest_neighbour_takes_the_wrong_passage_of_a_path_that_repeats() -> None:
    angle = np.linspace(0, 4 * np.pi, 800, endpoint=False)
    points = 100 * np.column_stack([np.cos(angle), np.sin(angle)])
    index, distance = nearest_neighbour(points, points + 0.01)
    assert distance.max() < 0.03
    assert (np.abs(index - np.arange(800)) > 300).any()


def test_nearest_neighbour_agrees_with_brute_force() -> None:
    rng = np.random.default_rng(2)
    points, queries = rng.standard_normal((300, 3)), rng.standard_normal((40, 3))
    index, distance = nearest_neighbour(points, queries)
    every = np.linalg.norm(points[None] - queries[:, None], axis=2)
    assert np.array_equal(index, every.argmin(axis=1))
    np.testing.assert_allclose(distance, every.min(axis=1))
