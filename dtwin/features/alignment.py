"""Alignment of streams that share a motion but no clock."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dtwin.errors import InputError
from dtwin.features.stops import Stop, find_stops, parabola_peak, stop_envelope, true_period
from dtwin.schema import Floats

__all__ = [
    "Alignment",
    "Stop",
    "align_envelopes",
    "align_periodic",
    "align_stops",
    "find_stops",
    "nearest_neighbour",
    "stop_envelope",
    "true_period",
    "unwrap_angle",
]


@dataclass(frozen=True)
class Alignment:
    """How one stream's clock stands to a reference clock.

    Attributes
    ----------
    lag_s : float
        Reference time = stream time + ``lag_s``.
    correlation : float
        Of the two records at that lag.
    residual : float
        RMS of the difference of the two standardised records; 0 is perfect, sqrt(2) unrelated.
    sharpness : float
        Peak correlation minus the best one outside the peak's own width; near 0 the lag is
        ambiguous, as between two like half turns.
    resolution_s : float
        Spacing of the common grid; the parabola refines the lag below it.
    """

    lag_s: float
    correlation: float
    residual: float
    sharpness: float
    resolution_s: float


def align_envelopes(
    stream: Floats,
    stream_rate_hz: float,
    reference: Floats,
    reference_rate_hz: float,
    *,
    max_lag_s: float,
    around_s: float = 0.0,
    min_overlap: float = 0.6,
    guard_s: float = 0.5,
) -> Alignment:
    """Align two records by normalised cross-correlation with a sub-sample peak.

    Parameters
    ----------
    stream, reference : ndarray, shapes (n,) and (m,)
        Envelopes or other records of one motion, each starting at time 0 of its own clock.
    stream_rate_hz, reference_rate_hz : float
        Sample rates; both are brought to the higher one.
    max_lag_s, around_s : float
        The lag is searched within ``around_s`` +- ``max_lag_s``.
    min_overlap : float
        Share of the shorter record that must overlap.
    guard_s : float
        Half width that belongs to the peak itself when its sharpness is judged.

    Raises
    ------
    InputError
        When no lag leaves enough overlap, or a record is constant.
    """
    rate_hz = max(stream_rate_hz, reference_rate_hz)
    a = _resampled(stream, stream_rate_hz, rate_hz)
    b = _resampled(reference, reference_rate_hz, rate_hz)
    needed = int(min_overlap * min(len(a), len(b)))
    low = round((around_s - max_lag_s) * rate_hz)
    lags = np.arange(low, round((around_s + max_lag_s) * rate_hz) + 1)
    lags = lags[np.minimum(len(b), len(a) + lags) - np.maximum(0, lags) >= max(needed, 3)]
    if not len(lags):
        raise InputError(
            "no lag leaves enough of the two records in common",
            code="align.overlap",
            got=f"{len(a) / rate_hz:z.2f} s and {len(b) / rate_hz:z.2f} s",
            hint="lengthen the recordings or widen max_lag_s",
        )
    values = np.array([_overlap_correlation(a, b, int(lag)) for lag in lags])
    best = int(np.argmax(values))
    peak = float(values[best])
    if peak <= 0:
        raise InputError("the two records share no motion", code="align.unrelated", got=f"best correlation {peak:z.2f}")
    outside = np.abs(lags - lags[best]) > guard_s * rate_hz
    rival = float(values[outside].max()) if outside.any() else 0.0
    return Alignment(
        lag_s=(float(lags[best]) + parabola_peak(values, best)) / rate_hz,
        correlation=peak,
        residual=float(np.sqrt(max(0.0, 2 - 2 * peak))),
        sharpness=peak - max(0.0, rival),
        resolution_s=1 / rate_hz,
    )


def align_stops(
    stream: Floats,
    stream_rate_hz: float,
    acceleration: Floats,
    controller_rate_hz: float,
    *,
    max_lag_s: float,
    around_s: float = 0.0,
    cutoff_hz: float = 20.0,
) -> Alignment:
    """Align a measured stream to the controller by the stops between arcs.

    Parameters
    ----------
    stream : ndarray, shape (n,)
        Measured deviation or acceleration, any unit; its bursts above ``cutoff_hz`` are used.
    acceleration : ndarray, shape (m,)
        Size of the controller's commanded acceleration along the path, any unit.
    max_lag_s, around_s : float
        As in ``align_envelopes``.

    Raises
    ------
    InputError
        When the records cannot be aligned.
    """
    envelope = stop_envelope(stream, stream_rate_hz, cutoff_hz)
    # The root brings tall and short bursts nearer, so that one stop does not decide alone.
    commanded = np.sqrt(np.abs(acceleration))
    width = max(3, round(0.1 * controller_rate_hz))
    smooth = np.convolve(commanded, np.ones(width) / width, "same")
    return align_envelopes(
        np.sqrt(envelope), stream_rate_hz, smooth, controller_rate_hz, max_lag_s=max_lag_s, around_s=around_s
    )


def unwrap_angle(angle_rad: Floats) -> Floats:
    """Return an angle without its jumps by full turns.

    Raises
    ------
    InputError
        When successive samples differ by so much that the number of turns is a guess.
    """
    unwrapped: Floats = np.unwrap(angle_rad)
    step = float(np.abs(np.diff(unwrapped)).max(initial=0.0))
    if not np.isfinite(unwrapped).all() or step > 0.75 * np.pi:
        raise InputError(
            "the angle is sampled too coarsely, or holds values that are not finite",
            code="align.angle",
            got=f"steps up to {np.degrees(step):z.0f} deg",
            allowed="less than 135 deg per sample",
        )
    return unwrapped


def align_periodic(
    stream: Floats, stream_angle_rad: Floats, reference: Floats, reference_angle_rad: Floats, *, n_grid: int = 3600
) -> tuple[float, Alignment]:
    """Align two records that repeat with a rotation, by circular correlation over the angle.

    Parameters
    ----------
    stream, reference : ndarray, shapes (n,) and (m,)
        Records of one quantity.
    stream_angle_rad, reference_angle_rad : ndarray, shapes (n,) and (m,)
        Angle of each sample; wrapped or not; each must cover one turn.
    n_grid : int
        Points per turn of the common grid.

    Returns
    -------
    tuple of float and Alignment
        Angle to add to the stream's angle, in (-pi, pi]; the alignment's times are that
        angle's share of a turn, with one turn counted as one second.

    Raises
    ------
    InputError
        When an angle is unusable or covers less than a turn.
    """
    a = _per_turn(stream, stream_angle_rad, n_grid)
    b = _per_turn(reference, reference_angle_rad, n_grid)
    size = float(np.sqrt((a @ a) * (b @ b)))
    if size <= 0:
        raise InputError("a record is constant", code="align.constant")
    values = np.fft.irfft(np.fft.rfft(b) * np.fft.rfft(a).conj(), n_grid) / size
    best = int(np.argmax(values))
    rolled = np.roll(values, n_grid // 2 - best)
    share = (best + parabola_peak(rolled, n_grid // 2)) / n_grid
    share -= round(share - 1e-12)
    guard = n_grid // 20
    outside = np.r_[rolled[: n_grid // 2 - guard], rolled[n_grid // 2 + guard :]]
    peak = float(values[best])
    return 2 * np.pi * share, Alignment(
        lag_s=share,
        correlation=peak,
        residual=float(np.sqrt(max(0.0, 2 - 2 * peak))),
        sharpness=peak - max(0.0, float(outside.max())),
        resolution_s=1 / n_grid,
    )


def nearest_neighbour(points: Floats, queries: Floats) -> tuple[NDArray[np.int64], Floats]:
    """Return for each query the nearest point: the baseline that ignores time and order.

    Parameters
    ----------
    points : ndarray, shape (n, d)
        Positions with a reading.
    queries : ndarray, shape (m, d)
        Positions that want one.

    Returns
    -------
    tuple of ndarray, shapes (m,) and (m,)
        Index of the nearest point, and its distance. On a path that crosses or repeats
        itself the nearest point may belong to another passage.
    """
    index = np.empty(len(queries), dtype=np.int64)
    distance = np.empty(len(queries))
    chunk = max(1, 4_000_000 // max(1, points.size))
    for start in range(0, len(queries), chunk):
        part = queries[start : start + chunk]
        squares = ((part[:, None, :] - points[None, :, :]) ** 2).sum(axis=2)
        index[start : start + chunk] = squares.argmin(axis=1)
        distance[start : start + chunk] = np.sqrt(squares.min(axis=1))
    return index, distance


def _resampled(signal: Floats, rate_hz: float, wanted_hz: float) -> Floats:
    if rate_hz == wanted_hz:
        return np.asarray(signal, dtype=np.float64)
    n = int((len(signal) - 1) / rate_hz * wanted_hz) + 1
    grid = np.arange(n) / wanted_hz
    return np.interp(grid, np.arange(len(signal)) / rate_hz, signal)


def _overlap_correlation(a: Floats, b: Floats, lag: int) -> float:
    first, last = max(0, lag), min(len(b), len(a) + lag)
    x, y = a[first - lag : last - lag], b[first:last]
    x, y = x - x.mean(), y - y.mean()
    size = float(np.sqrt((x @ x) * (y @ y)))
    return float(x @ y) / size if size > 0 else 0.0


def _per_turn(signal: Floats, angle_rad: Floats, n_grid: int) -> Floats:
    """Average a record over turns on a uniform grid of angles, mean removed."""
    unwrapped = unwrap_angle(angle_rad)
    if np.ptp(unwrapped) < 2 * np.pi * (1 - 1e-9):
        raise InputError(
            "the record covers less than one turn", code="align.turn", got=f"{np.degrees(np.ptp(unwrapped)):z.0f} deg"
        )
    order = np.argsort(unwrapped, kind="stable")
    angle, value = unwrapped[order], np.asarray(signal, dtype=np.float64)[order]
    first = np.ceil(angle[0] / (2 * np.pi) * n_grid)
    turns = max(1, int((angle[-1] / (2 * np.pi) * n_grid - first + 1) // n_grid))
    steps = first + np.arange(turns * n_grid)
    grid = np.interp(steps * 2 * np.pi / n_grid, angle, value)
    mean = np.roll(grid.reshape(turns, n_grid).mean(axis=0), int(first) % n_grid)
    return mean - mean.mean()
