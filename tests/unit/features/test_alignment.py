"""Streams with known offsets between their clocks."""

from __future__ import annotations

import numpy as np
import pytest

from dtwin.errors import InputError
from dtwin.features.alignment import align_envelopes, align_stops

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
        align_envelopes(np.ones(2), 100.0, np.ones(100), 100.0, max_lag_s=0.1)
