"""Filters against an independent library, against each other and against what must hold."""

from __future__ import annotations

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter, MerweScaledSigmaPoints, UnscentedKalmanFilter

from dtwin.errors import InputError
from dtwin.schema import Floats
from studies.dynamics.filters import (
    LowPass,
    RandomWalkFilter,
    Smoother,
    UnscentedFilter,
    kalman_kernel,
    response,
    smooth_kernel,
    unscented_kernel,
)

ANGLE = np.linspace(0.0, 2 * np.pi, 360, endpoint=False)


def shaken(seed: int = 0, vibration_um: float = 10.0) -> Floats:
    noise = vibration_um * (np.random.default_rng(seed).random(360) - 0.5)
    return np.asarray(12.0 * np.cos(2 * ANGLE) + 5.0 * np.sin(3 * ANGLE) + noise)


def independent(read: Floats, model: str, alpha: float) -> Floats:
    """The same filter by filterpy."""
    radius, step = 50_000.0, 2 * np.pi / 360
    turn = np.array([[np.cos(step), -np.sin(step)], [np.sin(step), np.cos(step)]])
    size = 2 if model == "circle" else 1
    by = UnscentedKalmanFilter(
        size,
        1,
        1.0,
        hx=lambda x: np.array([np.hypot(*x) - radius if size == 2 else x[0]]),
        fx=lambda x, dt: turn @ x if size == 2 and dt else x,
        points=MerweScaledSigmaPoints(size, alpha, 2.0, 0.0),
    )
    by.x = np.array([radius + read[0], 0.0][:size] if size == 2 else [read[0]])
    by.P, by.Q, by.R = 0.01 * np.eye(size), 1e-3 * np.eye(size), np.eye(1)
    out = []
    for number, value in enumerate(read):
        by.predict(dt=float(number > 0))
        by.sigmas_f = by.points_fn.sigma_points(by.x, by.P)
        by.update(np.array([value]))
        out.append(by.hx(by.x)[0])
    return np.array(out)


@pytest.mark.parametrize("model", ["random-walk", "circle"])
@pytest.mark.parametrize("alpha", [0.05, 1.0])
def test_the_unscented_filter_agrees_with_an_independent_library(model: str, alpha: float) -> None:
    settings = np.array([alpha, 1e-3, 1.0, 1e-2])
    kind = ["random-walk", "circle"].index(model)
    found = unscented_kernel(shaken(), kind, 50_000.0, 2 * np.pi / 360, settings)
    assert found == pytest.approx(independent(shaken(), model, alpha), abs=2e-5)


def test_filter_and_smoother_agree_with_an_independent_library() -> None:
    read = shaken()
    by = KalmanFilter(1, 1)
    by.x, by.P, by.F, by.H = read[:1].reshape(1, 1), 0.01 * np.eye(1), np.eye(1), np.eye(1)
    by.Q, by.R = 1e-3 * np.eye(1), np.eye(1)
    states, variances, _, _ = by.batch_filter(read)
    smooth = by.rts_smoother(states, variances)[0]
    found = kalman_kernel(read, 1e-3, 1.0, 0.01)
    assert found[0] == pytest.approx(states.ravel(), abs=1e-9)
    assert smooth_kernel(*found) == pytest.approx(smooth.ravel(), abs=1e-9)


def test_alpha_does_nothing_to_a_linear_model_and_little_to_the_circle() -> None:
    alphas = (1e-4, 1e-3, 1e-2, 0.1, 1.0)
    linear = [np.ptp(UnscentedFilter(alpha=a).static_um(shaken())) for a in alphas]
    assert np.ptp(linear) < 1e-6 * linear[0]
    assert linear[0] == pytest.approx(np.ptp(RandomWalkFilter().static_um(shaken())), rel=1e-6)
    circle = [np.ptp(UnscentedFilter("circle", a).static_um(shaken())) for a in (1e-3, 0.1, 1.0)]
    assert 0.0 < np.ptp(circle) < 1.0


def test_the_published_variances_eat_two_lobes_at_360_readings_and_not_at_15708() -> None:
    coarse = response(RandomWalkFilter(), 360)
    assert coarse.gain == pytest.approx(0.67, abs=0.01)
    assert coarse.lag_deg == pytest.approx(23.5, abs=1.0)
    assert coarse.taken > 0.5
    assert response(RandomWalkFilter(), 15_708).taken < 0.03
    assert abs(response(Smoother(), 360).lag_deg) < 1e-3
    assert response(LowPass(), 360).taken < 1e-3
    half = response(LowPass(15.0), 360, 15)
    assert (half.gain, half.lag_deg) == pytest.approx((0.5, 0.0), abs=1e-9)


def test_filters_that_look_both_ways_leave_a_smooth_shape_and_take_the_noise() -> None:
    clean, read = shaken(vibration_um=0.0), shaken()
    for chosen in (Smoother(q_um2=0.1), LowPass()):
        static = chosen.static_um(read)
        assert np.std(static - clean) < 0.5 * np.std(read - clean)


def test_what_cannot_be_a_filter_is_refused() -> None:
    for made, told in (
        (lambda: UnscentedFilter(alpha=2.0), "cannot be set"),
        (lambda: UnscentedFilter("spiral"), "no such model"),
        (lambda: RandomWalkFilter(q_um2=0.0), "variance"),
        (lambda: LowPass(0.0), "cutoff"),
    ):
        with pytest.raises(InputError, match=told):
            made()
