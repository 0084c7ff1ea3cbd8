from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from dtwin.train.library import Mode, free_step


@pytest.mark.parametrize("mode", [Mode(9.4, 0.035), Mode(26.0, 0.1)])
def test_a_free_step_is_the_differential_equation(mode: Mode) -> None:
    w = 2 * np.pi * mode.frequency_hz

    def slope(_: float, y: np.ndarray) -> list[float]:
        return [y[1], -2 * mode.damping_ratio * w * y[1] - w**2 * y[0]]

    start = np.array([0.3, -2.0])
    exact = solve_ivp(slope, (0, 0.1), start, rtol=1e-11, atol=1e-12).y[:, -1]
    step = np.array(free_step(mode, 0.002))
    found = start
    for _ in range(50):
        found = step @ found
    np.testing.assert_allclose(found, exact, rtol=1e-7, atol=1e-9)
