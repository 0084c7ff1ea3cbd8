"""What does not repeat when the virtual mill is measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dtwin.errors import InputError
from dtwin.schema import Floats

_GRID = 360
_KINDS = ("plain", "feed", "reversal", "tails", "bad_run", "lobes")


@dataclass(frozen=True)
class NoiseParameters:
    """Random part of a measurement, by run.

    ``rms_um``: size over one run, averaged over runs; 0 measures without noise.
    ``kind``: ``plain``; ``feed``: in proportion to feed; ``reversal``: four times at reversals; ``tails``: Student's t
    with three degrees of freedom; ``bad_run``: one run eight times; ``lobes``: three lobes of random height in every
    run.
    ``keep``: correlation of the slow part from degree to degree.
    ``reference_feed_mm_min``: feed at which the kind ``feed`` has its nominal size.
    """

    rms_um: float = 0.5
    kind: str = "plain"
    keep: float = 0.95
    reference_feed_mm_min: float = 2300.0

    def __post_init__(self) -> None:
        if self.kind not in _KINDS:
            raise InputError("unknown kind of noise", code="mill.noise", got=self.kind[:40], allowed=", ".join(_KINDS))


def noise_um(
    parameters: NoiseParameters, angle_rad: Floats, feed_mm_min: float, rng: np.random.Generator, *, bad: bool
) -> Floats:
    """Return the noise of one run, shape (n,). ``angle_rad``, (n,): path angle of the samples."""
    per_degree = len(angle_rad) / _GRID
    fast = 0.3 * np.sqrt(max(per_degree, 1.0)) * _draw(parameters, len(angle_rad), rng)
    slow = 0.3 * _slow(parameters, rng)
    degree = np.degrees(angle_rad) % 360.0
    out = fast + np.interp(degree, np.arange(_GRID) + 0.5, slow, period=360.0)
    out += 0.15 * rng.standard_normal()
    for order in range(1, 5):
        a, b = 0.15 * _draw(parameters, 2, rng)
        out += a * np.cos(order * angle_rad) + b * np.sin(order * angle_rad)
    scale = parameters.rms_um / np.sqrt(2 * 0.3**2 + 0.15**2 + 4 * 0.15**2)
    if parameters.kind == "lobes":
        a, b = rng.standard_normal(2)
        out += a * np.cos(3.0 * angle_rad) + b * np.sin(3.0 * angle_rad)
    if parameters.kind == "feed":
        scale *= feed_mm_min / parameters.reference_feed_mm_min
    if parameters.kind == "reversal":
        out *= np.where(np.abs((degree + 45.0) % 90.0 - 45.0) < 10.0, 4.0, 1.0)
    if bad and parameters.kind == "bad_run":
        scale *= 8.0
    return np.asarray(scale * out)


def _draw(parameters: NoiseParameters, n: int, rng: np.random.Generator) -> Floats:
    if parameters.kind == "tails":
        return np.asarray(rng.standard_t(3, n) / np.sqrt(3.0))
    return rng.standard_normal(n)


def _slow(parameters: NoiseParameters, rng: np.random.Generator) -> Floats:
    """Return a first-order autoregressive series of unit variance over one turn."""
    fresh = _draw(parameters, 2 * _GRID, rng)
    weights = parameters.keep ** np.arange(_GRID) * np.sqrt(1.0 - parameters.keep**2)
    return np.convolve(fresh, weights)[_GRID - 1 : 2 * _GRID - 1]
