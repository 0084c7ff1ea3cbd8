"""Training of a small network by Levenberg-Marquardt."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from dtwin.kinds.linear._small_net import SmallNet
from dtwin.schema import Floats

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


def train_net(net: SmallNet, inputs: Floats, target: Floats, *, epochs: int, goal: float) -> Trained:
    """Train a network on all data at once until the goal or the last epoch.

    ``inputs`` (n, inputs): inputs.
    ``target`` (n,): wanted outputs.
    ``goal``: sum of squared errors at which to stop.
    """
    begun = time.perf_counter()
    best, steps = levenberg_marquardt(net, inputs, target, epochs, goal)
    sse = float(np.sum((best.evaluate(inputs) - target) ** 2))
    return Trained(best, sse, steps, time.perf_counter() - begun)


def levenberg_marquardt(
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
