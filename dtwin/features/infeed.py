"""Align a ball bar with the controller by the in-feed and out-feed that both of them see."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dtwin.errors import InputError
from dtwin.features.alignment import Alignment
from dtwin.schema import Floats

# Range and spacing of the lags that are tried; a parabola refines the best one.
_LONGEST_S, _STEP_S = 3.0, 0.005
_HARMONICS = 2
_THINNED_S = 0.02
_COARSE = 8


def align_infeed(
    deviation_um: Floats, rate_hz: float, commanded_um: Floats, angle_rad: Floats, controller_rate_hz: float
) -> Alignment:
    """Find the lag at which the bar follows the commanded distance from the centre.

    The bar sees the whole radial in-feed, of which the controller knows the course. Centre,
    radius and the second harmonic are fitted anew at every lag, because an eccentric set-up
    would shift the in-feed.

    ``deviation_um``, shape (n,): bar, from its first sample.
    ``commanded_um``, shape (m,): commanded distance from the centre minus nominal radius.
    ``angle_rad``, shape (m,): commanded path angle.
    Returns ``residual`` is the share of the bar's RMS that remains.
    Raises ``InputError`` when the controller's record does not cover the bar's at any lag.
    """
    thin = max(1, round(rate_hz * _THINNED_S))
    t_bar = np.arange(deviation_um.size)[::thin] / rate_hz
    bar = deviation_um[::thin]
    t_controller = np.arange(commanded_um.size) / controller_rate_hz
    longest = min(_LONGEST_S, t_controller[-1] - 0.5 * t_bar[-1])
    if longest < 3 * _STEP_S:
        raise InputError(
            "the controller's record is shorter than the bar's",
            code="align.overlap",
            got=f"{t_controller[-1]:z.1f} s and {t_bar[-1]:z.1f} s",
        )

    def unexplained(lags: NDArray[np.floating]) -> Floats:
        at = t_bar + lags[:, None]
        wave = np.exp(1j * np.interp(at, t_controller, angle_rad))
        y = bar - np.interp(at, t_controller, commanded_um)
        design = np.empty((lags.size, 1 + 2 * _HARMONICS, bar.size))
        design[:, 0] = 1.0
        for k in range(1, _HARMONICS + 1):
            design[:, 2 * k - 1], design[:, 2 * k] = (wave**k).real, (wave**k).imag
        gram = design @ design.transpose(0, 2, 1)
        moment = (design @ y[:, :, None])[:, :, 0]
        ridge = 1e-9 * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(design.shape[1])
        solved = np.linalg.solve(gram + ridge, moment[:, :, None])[:, :, 0]
        return np.maximum(np.sum(y**2, axis=1) - np.sum(moment * solved, axis=1), 0.0) / bar.size

    coarse = np.arange(0.0, longest, _COARSE * _STEP_S)
    overview = unexplained(coarse)
    middle_s = float(coarse[int(np.argmin(overview))])
    lags = middle_s + _STEP_S * np.arange(-_COARSE, _COARSE + 1)
    rest = unexplained(lags)
    best = int(np.argmin(rest))
    shift = 0.0
    if 0 < best < lags.size - 1:
        left, middle, right = rest[best - 1 : best + 2]
        bend = left - 2 * middle + right
        shift = float(0.5 * (left - right) / bend) if bend > 0 else 0.0
    guard = np.abs(coarse - lags[best]) > 0.5
    rival = float(overview[guard].min()) if guard.any() else float("inf")
    scale = float(np.var(bar)) or 1.0
    return Alignment(
        lag_s=float(lags[best] + shift * _STEP_S),
        correlation=float(np.sqrt(max(0.0, 1.0 - rest[best] / scale))),
        residual=float(np.sqrt(rest[best] / scale)),
        sharpness=float(1.0 - rest[best] / rival) if rival > 0 else 0.0,
    )
