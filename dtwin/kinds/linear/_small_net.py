"""A network of one hidden layer of logistic neurons, small enough for training by Levenberg-Marquardt."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from dtwin.schema import Floats
from dtwin.serve.builder import Expression, GraphBuilder

# Where a logistic neuron is neither off nor on.
_ACTIVE = 4.0


@dataclass(frozen=True)
class SmallNet:
    """Weights.

    ``weights``, (hidden, inputs): from inputs to neurons.
    ``biases``, ``out_weights``, (hidden,): of the neurons, and from them to the output.
    """

    weights: Floats
    biases: Floats
    out_weights: Floats
    out_bias: float

    @property
    def hidden(self) -> int:
        """Number of neurons."""
        return len(self.biases)

    def evaluate(self, inputs: Floats) -> Floats:
        """Return outputs, shape (n,), of inputs, shape (n, inputs)."""
        return self._active(inputs) @ self.out_weights + self.out_bias

    def with_jacobian(self, inputs: Floats) -> tuple[Floats, Floats]:
        """Return outputs (n,) and their derivatives by all parameters (n, parameters)."""
        active = self._active(inputs)
        slope = active * (1.0 - active) * self.out_weights
        by_weights = slope[:, :, None] * inputs[:, None, :]
        ones = np.ones((len(inputs), 1))
        jacobian = np.hstack([by_weights.reshape(len(inputs), -1), slope, active, ones])
        return active @ self.out_weights + self.out_bias, jacobian

    def gradient(self, inputs: Floats, target: Floats) -> tuple[float, Floats]:
        """Return the sum of squared errors and its gradient (parameters,)."""
        active = self._active(inputs)
        error = active @ self.out_weights + self.out_bias - target
        slope = active * (1.0 - active) * self.out_weights * error[:, None]
        parts = [(slope.T @ inputs).ravel(), slope.sum(axis=0), active.T @ error, [float(error.sum())]]
        return float(error @ error), 2.0 * np.concatenate(parts)

    def parameters(self) -> Floats:
        """Return all parameters in the order of the Jacobian's columns."""
        return np.concatenate([self.weights.ravel(), self.biases, self.out_weights, [self.out_bias]])

    def with_parameters(self, values: Floats) -> SmallNet:
        """Return a net of the same shape with other parameters."""
        n = self.weights.size
        h = self.hidden
        return SmallNet(
            values[:n].reshape(self.weights.shape), values[n : n + h], values[n + h : n + 2 * h], float(values[-1])
        )

    def expression(self, builder: GraphBuilder, inputs: Sequence[Expression]) -> Expression:
        """Return the net as a term of a bundle's graph."""
        terms = []
        for row, bias, out in zip(self.weights.tolist(), self.biases.tolist(), self.out_weights.tolist(), strict=True):
            weighted = [x * w for x, w in zip(inputs, row, strict=True)]
            neuron = builder.apply("logistic", builder.total([*weighted, bias]))
            terms.append(neuron * out)
        return builder.total([*terms, self.out_bias])

    def _active(self, inputs: Floats) -> Floats:
        with np.errstate(over="ignore"):
            active: Floats = 1.0 / (1.0 + np.exp(-(inputs @ self.weights.T + self.biases)))
        return active


def new_net(hidden: int, ranges: Sequence[tuple[float, float]], rng: np.random.Generator) -> SmallNet:
    """Return a net whose neurons share the input space evenly.

    Nguyen and Widrow, *Improving the learning speed of 2-layer neural networks by choosing initial
    values of the adaptive weights*, IJCNN 1990.
    """
    n = len(ranges)
    low, high = np.array(ranges, dtype=float).T
    size = 0.7 * hidden ** (1.0 / n)
    drawn = rng.uniform(-1.0, 1.0, (hidden, n))
    drawn *= size / np.linalg.norm(drawn, axis=1, keepdims=True)
    biases = size * np.linspace(-1.0, 1.0, hidden) * np.sign(drawn[:, 0])
    weights = _ACTIVE * drawn / ((high - low) / 2.0)
    biases = _ACTIVE * biases - weights @ ((high + low) / 2.0)
    return SmallNet(weights, biases, rng.uniform(-1.0, 1.0, hidden), float(rng.uniform(-1.0, 1.0)))


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
