"""Stops and period, on the real recording and on made records with known truth."""

from __future__ import annotations

import numpy as np
import pytest

from dtwin.acquire.b5r import read_b5r
from dtwin.config import sample_recording
from dtwin.errors import InputError
from dtwin.features.stops import find_stops, lead_in_samples, true_period

RATE_HZ = 200.0
NOMINAL_S = 2 * np.pi * 100 / (5000 / 60)


def real_mm(run_id: str) -> np.ndarray:
    test = read_b5r(sample_recording())
    run = next(r for r in test.runs if r.meta.run_id == run_id)
    return np.asarray(run.samples["deviation_um"], dtype=np.float64) / 1000


@pytest.mark.parametrize(("run_id", "expected"), [("ccw", [810, 1609, 2387]), ("cw", [551, 1351, 2140])])
def test_stops_of_the_real_recording(run_id: str, expected: list[int]) -> None:
    found = [stop.sample for stop in find_stops(real_mm(run_id), RATE_HZ)][:3]
    np.testing.assert_allclose(found, expected, atol=15)


def test_true_period_of_the_real_clockwise_run_is_not_the_marked_one() -> None:
    x = real_mm("cw")
    first_stop = find_stops(x, RATE_HZ)[0]
    period = true_period(x, RATE_HZ, NOMINAL_S, skip_samples=first_stop.last)
    assert 1590 <= period.samples <= 1592
    assert period.correlation > 0.95


def test_lead_in_of_the_real_clockwise_run() -> None:
    assert 450 <= lead_in_samples(real_mm("cw"), RATE_HZ, 1591.0) <= 600


def bursts(times_s: list[float], length_s: float = 20.0) -> np.ndarray:
    t = np.arange(int(length_s * RATE_HZ)) / RATE_HZ
    x = 0.05 * np.sin(2 * np.pi * 0.13 * t) + 1e-3 * np.random.default_rng(0).standard_normal(len(t))
    for at in times_s:
        x += 0.05 * np.exp(-(((t - at) / 0.03) ** 2)) * np.sin(2 * np.pi * 40 * t)
    return x


def test_known_bursts_are_found_where_they_are() -> None:
    times = [4.0, 8.5, 12.25]
    found = find_stops(bursts(times), RATE_HZ)
    np.testing.assert_allclose([s.sample / RATE_HZ for s in found], times, atol=0.03)


def test_a_record_without_stops_has_none() -> None:
    assert find_stops(bursts([]), RATE_HZ) == ()
    assert find_stops(np.zeros(1000), RATE_HZ) == ()


def test_period_of_a_known_profile_between_samples() -> None:
    n, period = 4000, 1501.4
    phase = 2 * np.pi * np.arange(n) / period
    x = np.sin(2 * phase) + 0.5 * np.cos(7 * phase + 1) + 0.2 * np.sin(19 * phase)
    x[:300] += np.linspace(5, 0, 300)
    found = true_period(x, RATE_HZ, 7.5, skip_samples=300)
    assert found.samples == pytest.approx(period, abs=0.1)
    assert 230 <= lead_in_samples(x, RATE_HZ, found.samples) <= 310


def test_unusable_records_are_refused() -> None:
    with pytest.raises(InputError, match="too short"):
        true_period(np.zeros(1400), RATE_HZ, 7.5)
    with pytest.raises(InputError, match="not finite"):
        find_stops(np.full(100, np.nan), RATE_HZ)
