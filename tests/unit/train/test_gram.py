from __future__ import annotations

import numpy as np
import pytest

from dtwin.kinds.circular._term_columns import forward_order, solve, sums_of, total


@pytest.fixture
def data() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(2)
    x = rng.normal(size=(600, 7)) * [1, 10, 0.1, 1, 1, 1, 1]
    return x, x[:, [1, 4]] @ [0.7, -3.0] + 0.1 * rng.normal(size=600)


def test_without_penalty_it_is_least_squares(data: tuple[np.ndarray, np.ndarray]) -> None:
    x, y = data
    np.testing.assert_allclose(solve(sums_of(x, y), 0.0), np.linalg.lstsq(x, y, rcond=None)[0], rtol=1e-9)


def test_cells_add_up_and_the_residual_is_the_residual(data: tuple[np.ndarray, np.ndarray]) -> None:
    x, y = data
    both = total([sums_of(x[:200], y[:200]), sums_of(x[200:], y[200:])])
    weights = solve(both, 1e-3)
    np.testing.assert_allclose(weights, solve(sums_of(x, y), 1e-3), rtol=1e-9)
    assert both.residual(weights) == pytest.approx(float(np.sum((y - x @ weights) ** 2)))


def test_forward_order_finds_the_terms_that_matter_first(data: tuple[np.ndarray, np.ndarray]) -> None:
    x, y = data
    assert set(forward_order(sums_of(x, y), [[i] for i in range(7)], 1e-6)[:2]) == {1, 4}


def test_what_a_setup_absorbs_is_held_near_zero() -> None:
    rng = np.random.default_rng(3)
    seen, absorbed = rng.normal(size=(500, 2)), np.zeros((500, 2))
    seen[:, 1] = seen[:, 0]
    absorbed[:, 1] = 50.0
    y = seen[:, 0]
    free = solve(sums_of(seen, y), 1e-6)
    held = solve(sums_of(seen, y, absorbed), 1e-6)
    assert abs(free[1]) > 0.4
    assert abs(held[1]) < 1e-3
    assert held.sum() == pytest.approx(1.0, abs=0.01)
