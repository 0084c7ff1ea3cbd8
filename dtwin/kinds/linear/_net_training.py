"""Four ways to train a small network: Levenberg-Marquardt, BFGS, scaled conjugate gradients, RProp."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import linalg, optimize

from dtwin.errors import InputError
from dtwin.kinds.linear._small_net import SmallNet
from dtwin.schema import Floats

ALGORITHMS = ("levenberg-marquardt", "bfgs", "scg", "rprop")
_MU_START, _MU_STEP, _MU_MOST = 1e-3, 10.0, 1e10
_SMALLEST_GRADIENT = 1e-12


@dataclass(frozen=True)
class Trained:
    """A trained network.

    ``net``: the best found.
    ``sse``: its sum of squared errors over the training data.
    ``epochs``: steps that were taken.
    """

    net: SmallNet
    sse: float
    epochs: int
    seconds: float


def train_net(
    net: SmallNet,
    inputs: Floats,
    target: Floats,
    *,
    algorithm: str = "levenberg-marquardt",
    epochs: int = 1000,
    goal: float = 0.0,
) -> Trained:
    """Train a network on all data at once until the goal or the last epoch.

    ``inputs`` (n, inputs): inputs.
    ``target`` (n,): wanted outputs.
    ``algorithm``: one of ``ALGORITHMS``.
    ``goal``: sum of squared errors at which to stop.
    Raises ``InputError`` when there is no such algorithm.
    """
    methods: dict[str, _Method] = {
        "levenberg-marquardt": _levenberg_marquardt,
        "bfgs": _bfgs,
        "scg": _scg,
        "rprop": _rprop,
    }
    if algorithm not in methods:
        raise InputError("no such training", code="train.algorithm", got=algorithm[:40], allowed=", ".join(ALGORITHMS))
    begun = time.perf_counter()
    best, steps = methods[algorithm](net, inputs, target, epochs, goal)
    sse = float(np.sum((best.evaluate(inputs) - target) ** 2))
    return Trained(best, sse, steps, time.perf_counter() - begun)


_Method = Callable[[SmallNet, Floats, Floats, int, float], tuple[SmallNet, int]]


def _levenberg_marquardt(
    net: SmallNet, inputs: Floats, target: Floats, epochs: int, goal: float
) -> tuple[SmallNet, int]:
    """Damped Gauss-Newton; the damping falls tenfold on success and grows tenfold on failure."""
    mu, values = _MU_START, net.parameters()
    output, jacobian = net.with_jacobian(inputs)
    error = output - target
    sse = float(error @ error)
    for epoch in range(epochs):
        if sse <= goal:
            return net, epoch
        normal, slope = jacobian.T @ jacobian, jacobian.T @ error
        if float(np.max(np.abs(slope))) < _SMALLEST_GRADIENT:
            return net, epoch
        while True:
            step = _solved(normal, mu, slope)
            tried = net.with_parameters(values - step)
            new = float(np.sum((tried.evaluate(inputs) - target) ** 2))
            if new < sse:
                break
            mu *= _MU_STEP
            if mu > _MU_MOST:
                return net, epoch
        mu = max(mu / _MU_STEP, 1e-20)
        net, values = tried, values - step
        output, jacobian = net.with_jacobian(inputs)
        error = output - target
        sse = float(error @ error)
    return net, epochs


def _solved(normal: Floats, mu: float, slope: Floats) -> Floats:
    damped = normal.copy()
    damped.flat[:: len(slope) + 1] += mu
    try:
        factor = linalg.cho_factor(damped, lower=True, check_finite=False)
        return linalg.cho_solve(factor, slope, check_finite=False)
    except linalg.LinAlgError:
        return np.asarray(np.linalg.lstsq(damped, slope, rcond=None)[0], dtype=np.float64)


def _bfgs(net: SmallNet, inputs: Floats, target: Floats, epochs: int, goal: float) -> tuple[SmallNet, int]:
    def objective(values: Floats) -> tuple[float, Floats]:
        return net.with_parameters(values).gradient(inputs, target)

    def reached(intermediate_result: optimize.OptimizeResult) -> None:
        if intermediate_result.fun <= goal:
            raise StopIteration

    solution = optimize.minimize(
        objective,
        net.parameters(),
        jac=True,
        method="BFGS",
        callback=reached,
        options={"maxiter": epochs, "gtol": _SMALLEST_GRADIENT},
    )
    return net.with_parameters(solution.x), int(solution.nit)


def _scg(net: SmallNet, inputs: Floats, target: Floats, epochs: int, goal: float) -> tuple[SmallNet, int]:
    """Scaled conjugate gradients (Moller, Neural Networks 6, 1993): no line search."""
    values = net.parameters()
    sse, gradient = net.gradient(inputs, target)
    residual = -gradient
    direction = residual.copy()
    scale, extra, success, curvature = 5e-7, 0.0, True, 0.0
    for epoch in range(epochs):
        length2 = float(direction @ direction)
        if sse <= goal or length2 < _SMALLEST_GRADIENT**2:
            return net.with_parameters(values), epoch
        if success:
            small = 5e-5 / np.sqrt(length2)
            ahead = net.with_parameters(values + small * direction).gradient(inputs, target)[1]
            curvature = float(direction @ (ahead - gradient)) / small
        curvature += (scale - extra) * length2
        if curvature <= 0.0:
            extra = 2.0 * (scale - curvature / length2)
            curvature = -curvature + scale * length2
            scale = extra
        along = float(direction @ residual)
        step = along / curvature
        new_sse, new_gradient = net.with_parameters(values + step * direction).gradient(inputs, target)
        gain = 2.0 * curvature * (sse - new_sse) / along**2 if along else -1.0
        success = gain >= 0.0
        if success:
            values, sse, gradient = values + step * direction, new_sse, new_gradient
            extra, new_residual = 0.0, -new_gradient
            if (epoch + 1) % len(values) == 0:
                direction = new_residual.copy()
            else:
                turn = float(new_residual @ new_residual - new_residual @ residual) / along
                direction = new_residual + turn * direction
            residual = new_residual
            scale = scale / 4.0 if gain >= 0.75 else scale
        else:
            extra = scale
        if gain < 0.25:
            scale = min(scale + curvature * (1.0 - gain) / length2, 1e100)
    return net.with_parameters(values), epochs


def _rprop(net: SmallNet, inputs: Floats, target: Floats, epochs: int, goal: float) -> tuple[SmallNet, int]:
    """Resilient propagation (Riedmiller and Braun, ICNN 1993): signs of the gradient only."""
    values = net.parameters()
    best, best_sse = values, np.inf
    steps, before = np.full(len(values), 0.07), np.zeros(len(values))

    for epoch in range(epochs):
        sse, gradient = net.with_parameters(values).gradient(inputs, target)
        if sse < best_sse:
            best, best_sse = values, sse
        if sse <= goal:
            return net.with_parameters(best), epoch
        agree = np.sign(gradient * before)
        steps = np.clip(steps * np.where(agree > 0, 1.2, np.where(agree < 0, 0.5, 1.0)), 1e-12, 50.0)
        gradient = np.where(agree < 0, 0.0, gradient)
        values, before = values - np.sign(gradient) * steps, gradient
    return net.with_parameters(best), epochs
