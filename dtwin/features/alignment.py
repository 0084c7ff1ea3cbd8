"""Alignment of streams that share a motion but no clock."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dtwin.errors import InputError
from dtwin.features.stops import correlation, parabola_peak, stop_envelope
from dtwin.schema import Floats

__all__ = ["Alignment", "align_envelopes", "align_stops"]

# Product of two sums of squares, as a share of the whole records': below it is rounding.
_STILL = 1e-20

# Share of the shorter record that must overlap; half width that belongs to the peak itself when its sharpness is judged.
_LEAST_SHARED, _PEAK_S = 0.6, 0.5


@dataclass(frozen=True)
class Alignment:
    """How one stream's clock stands to a reference clock.

    Attributes:
        lag_s: Reference time = stream time + ``lag_s``.
        correlation: Of the two records at that lag.
        residual: RMS of the difference of the two standardised records; 0 is perfect, sqrt(2) unrelated.
        sharpness: Peak correlation minus the best one outside the peak's own width; near 0 the lag is ambiguous, as
            between two like half turns.
    """

    lag_s: float
    correlation: float
    residual: float
    sharpness: float


def align_envelopes(
    stream: Floats, stream_rate_hz: float, reference: Floats, reference_rate_hz: float, *, max_lag_s: float
) -> Alignment:
    """Align two records by normalised cross-correlation with a sub-sample peak.

    Args:
        stream: Envelope or other record of a motion, from time 0 of its own clock. Shape (n,).
        reference: The same of the other stream. Shape (m,).
        stream_rate_hz: Sample rate.
        reference_rate_hz: Sample rate; both are brought to the higher one.
        max_lag_s: How far from 0 the lag is searched.

    Raises:
        InputError: When no lag leaves enough overlap, or a record is constant.
    """
    rate_hz = max(stream_rate_hz, reference_rate_hz)
    a = _resampled(stream, stream_rate_hz, rate_hz)
    b = _resampled(reference, reference_rate_hz, rate_hz)
    needed = int(_LEAST_SHARED * min(len(a), len(b)))
    most = round(max_lag_s * rate_hz)
    lags = np.arange(-most, most + 1)
    lags = lags[np.minimum(len(b), len(a) + lags) - np.maximum(0, lags) >= max(needed, 3)]
    if not len(lags):
        raise InputError(
            "no lag leaves enough of the two records in common",
            code="align.overlap",
            got=f"{len(a) / rate_hz:z.2f} s and {len(b) / rate_hz:z.2f} s",
            hint="lengthen the recordings or widen max_lag_s",
        )
    values = _overlap_correlations(a, b, lags)
    best = int(np.argmax(values))
    peak = float(values[best])
    if peak <= 0:
        raise InputError("the two records share no motion", code="align.unrelated", got=f"best correlation {peak:z.2f}")
    outside = np.abs(lags - lags[best]) > _PEAK_S * rate_hz
    rival = float(values[outside].max()) if outside.any() else 0.0
    return Alignment(
        lag_s=(float(lags[best]) + parabola_peak(values, best)) / rate_hz,
        correlation=peak,
        residual=float(np.sqrt(max(0.0, 2 - 2 * peak))),
        sharpness=peak - max(0.0, rival),
    )


def align_stops(
    stream: Floats, stream_rate_hz: float, acceleration: Floats, controller_rate_hz: float, *, max_lag_s: float
) -> Alignment:
    """Align a measured stream to the controller by the stops between arcs.

    Args:
        stream: Measured deviation or acceleration, any unit; its bursts are used. Shape (n,).
        acceleration: Size of the controller's commanded acceleration along the path, any unit. Shape (m,).
        max_lag_s: As in ``align_envelopes``.

    Raises:
        InputError: When the records cannot be aligned.
    """
    envelope = stop_envelope(stream, stream_rate_hz)
    # The root brings tall and short bursts nearer, so that one stop does not decide alone.
    commanded = np.sqrt(np.abs(acceleration))
    width = max(3, round(0.1 * controller_rate_hz))
    smooth = np.convolve(commanded, np.ones(width) / width, "same")
    return align_envelopes(np.sqrt(envelope), stream_rate_hz, smooth, controller_rate_hz, max_lag_s=max_lag_s)


def _resampled(signal: Floats, rate_hz: float, wanted_hz: float) -> Floats:
    if rate_hz == wanted_hz:
        return np.asarray(signal, dtype=np.float64)
    n = int((len(signal) - 1) / rate_hz * wanted_hz) + 1
    grid = np.arange(n) / wanted_hz
    return np.interp(grid, np.arange(len(signal)) / rate_hz, signal)


def _overlap_correlations(a: Floats, b: Floats, lags: NDArray[np.int64]) -> Floats:
    """Return the correlation of what two records have in common, ``a`` shifted by each lag, shape (lags,)."""
    # Their own means out first: sums of squares of what is left do not cancel.
    a, b = a - a.mean(), b - b.mean()
    first, last = np.maximum(0, lags), np.minimum(len(b), len(a) + lags)
    n = last - first

    def over(values: Floats, begin: NDArray[np.int64], end: NDArray[np.int64]) -> Floats:
        sums = np.concatenate([[0.0], np.cumsum(values)])
        return np.asarray(sums[end] - sums[begin])

    x, y = over(a, first - lags, last - lags), over(b, first, last)
    square = (over(a**2, first - lags, last - lags) - x**2 / n) * (over(b**2, first, last) - y**2 / n)
    across = correlation(b, a)[lags + len(a) - 1] - x * y / n
    moves = square > _STILL * float(a @ a) * float(b @ b)
    return np.where(moves, across / np.sqrt(np.where(moves, square, 1.0)), 0.0)
