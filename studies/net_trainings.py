"""Four ways to train a small network, compared: Levenberg-Marquardt, BFGS, scaled conjugate gradients, RProp."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from scipy import optimize

from dtwin.kinds.linear._small_net import SmallNet, levenberg_marquardt
from dtwin.schema import Floats

_SMALLEST_GRADIENT = 1e-12
_Training = Callable[[SmallNet, Floats, Floats, int, float], tuple[SmallNet, int]]


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


TRAININGS: Mapping[str, _Training] = {
    "levenberg-marquardt": levenberg_marquardt,
    "bfgs": _bfgs,
    "scg": _scg,
    "rprop": _rprop,
}
"""By name; each takes a net, inputs (n, inputs), wanted outputs (n,), the most epochs, and the sum of squared errors at which to stop."""
