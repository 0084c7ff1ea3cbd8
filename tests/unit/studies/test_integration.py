"""The double-integration chain: right on what it can see, and honest on the rest."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.integrate
import scipy.signal

from dtwin.errors import InputError
from studies.integration import (
    coupled,
    displacement_mm,
    displacement_visibility,
    integrate,
    power_threshold_filter,
    swarm_minimum,
)

RATE_HZ = 10240.0


def test_integral_agrees_with_scipy() -> None:
    x = np.random.default_rng(0).standard_normal((3, 200))
    expected = scipy.integrate.cumulative_trapezoid(x, dx=1 / RATE_HZ, initial=0)
    np.testing.assert_allclose(integrate(x, RATE_HZ), expected, atol=1e-15)


def test_constant_acceleration_gives_half_a_t_squared() -> None:
    t = np.arange(800) / RATE_HZ
    expected = 0.5 * 1e-3 * 9806.65 * t**2
    np.testing.assert_allclose(displacement_mm(np.full(800, 1e-3), RATE_HZ), expected, rtol=1e-9, atol=1e-12)


def test_window_mean_of_a_milli_g_offset_is_ten_micrometres() -> None:
    mean_um = displacement_mm(np.full(800, 1e-3), RATE_HZ).mean() * 1000
    assert mean_um == pytest.approx(9.96, abs=0.05)


def test_threshold_keeps_the_strong_line_only() -> None:
    t = np.arange(1024) / 1024.0
    strong, weak = np.sin(2 * np.pi * 50 * t), 0.01 * np.sin(2 * np.pi * 200 * t)
    kept = power_threshold_filter(strong + weak, cutoff_power=1.0)
    np.testing.assert_allclose(kept, strong, atol=1e-12)
    assert not power_threshold_filter(strong + weak, 1e9).any()


def test_swarm_finds_a_known_minimum_and_repeats_itself() -> None:
    def objective(x: float) -> float:
        return (np.log10(x) + 2.3) ** 2 + 0.1 * np.cos(9 * np.log10(x))

    grid = 10 ** np.linspace(-6, 2, 20001)
    best = grid[np.argmin([objective(x) for x in grid])]
    first, second = (swarm_minimum(objective, 1e-6, 1e2, seed=4) for _ in range(2))
    assert first == second
    assert first.position == pytest.approx(best, rel=1e-2)


def test_swarm_stays_in_its_bounds_and_survives_a_bad_objective() -> None:
    found = swarm_minimum(lambda x: -x, 0.1, 3.0)
    assert found.position == pytest.approx(3.0)
    assert swarm_minimum(lambda _: float("nan"), 0.1, 3.0).value == np.inf
    with pytest.raises(InputError, match="positive"):
        swarm_minimum(lambda x: x, 0.0, 3.0)


def test_coupling_passes_no_constant_and_is_down_three_decibels_at_its_corner() -> None:
    assert not coupled(np.full(3000, 0.7), 200.0, 0.5).any()
    t = np.arange(40000) / 200.0
    out = coupled(np.sin(2 * np.pi * 0.5 * t), 200.0, 0.5)[20000:]
    assert np.std(out) * np.sqrt(2) == pytest.approx(np.sqrt(0.5), rel=1e-3)


@pytest.mark.parametrize("frequency_hz", [0.5, 2.0, 10.0])
def test_slow_motion_is_lost_when_windows_restart(frequency_hz: float) -> None:
    t = np.arange(int(8 * RATE_HZ)) / RATE_HZ
    motion_mm = 0.01 * np.sin(2 * np.pi * frequency_hz * t)
    found = displacement_visibility(motion_mm, RATE_HZ, 800, per_window_mean=True)
    assert found.lost_fraction > 0.9


def test_restarts_lose_what_one_long_dc_coupled_window_keeps() -> None:
    t = np.arange(int(4 * RATE_HZ)) / RATE_HZ
    motion_mm = 0.01 * (1 - np.cos(2 * np.pi * 10.0 * t))
    whole = displacement_visibility(motion_mm, RATE_HZ, len(t) // 2, corner_hz=0.0)
    short = displacement_visibility(motion_mm, RATE_HZ, 800, corner_hz=0.0)
    assert whole.lost_fraction < 0.05
    assert whole.correlation > 0.99
    assert short.lost_fraction > 0.5


def test_visibility_refuses_what_it_cannot_judge() -> None:
    with pytest.raises(InputError, match="two windows"):
        displacement_visibility(np.zeros(100), RATE_HZ, 80)
    with pytest.raises(InputError, match="constant"):
        displacement_visibility(np.zeros(400), RATE_HZ, 80)
