"""Landmarks of a circular record: stops between arcs, the true period, the lead-in; spectral tools of a whole record."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from dtwin.errors import InputError
from dtwin.schema import Floats

_ROUNDING = 1e-12
_CUTOFF_HZ = 20.0
# Envelope over its median that makes a burst; bursts nearer than this are one stop; one that begins this near the
# start is the instrument being triggered.
_STRONG, _APART_S, _TRIGGER_S = 6.0, 1.0, 0.3
# Of a revolution: search range as a share of the nominal time, and shortest stretch that may be compared.
_TOLERANCE, _SHORTEST_S = 0.12, 1.0


@dataclass(frozen=True)
class _Stop:
    """A burst of fast vibration where the machine stopped and started again.

    ``sample``: centre of the burst's energy, counted from 0.
    """

    sample: float
    first: int
    last: int


def stop_envelope(signal: Floats, rate_hz: float) -> Floats:
    """Return the moving RMS (0.1 s) of the part of a record above 20 Hz."""
    return _moving_rms(_above(signal, rate_hz, _CUTOFF_HZ), max(3, round(0.1 * rate_hz)))


def find_stops(signal: Floats, rate_hz: float) -> tuple[_Stop, ...]:
    """Find the stops of a circular record by their bursts above 20 Hz.

    ``signal``, shape (n,): deviation or acceleration; any unit.
    Returns them in order of time; empty when there is no burst.
    Raises ``InputError`` when the record holds a value that is not finite.
    """
    if not np.isfinite(signal).all():
        raise InputError("the record holds values that are not finite", code="align.finite")
    envelope = stop_envelope(signal, rate_hz)
    quiet = float(np.median(envelope))
    loud = np.flatnonzero(envelope > _STRONG * quiet)
    if quiet <= 0 or not len(loud):
        return ()
    parts = np.split(loud, np.flatnonzero(np.diff(loud) > _APART_S * rate_hz) + 1)
    stops = []
    for part in parts:
        energy = envelope[part] ** 2
        if part[0] < _TRIGGER_S * rate_hz:
            continue
        # The densest fifth of a second: the tails are ringing, longer on one side.
        width = max(1, round(0.2 * rate_hz))
        centre = float(part[int(np.argmax(np.convolve(energy, np.ones(width), "same")))])
        stops.append(_Stop(centre, int(part[0]), int(part[-1])))
    return tuple(stops)


@dataclass(frozen=True)
class _Period:
    """Time of one revolution, found by comparing a record with itself.

    ``samples``: one revolution, with sub-sample resolution.
    ``correlation``: between one revolution and the next.
    """

    samples: float
    correlation: float


def true_period(signal: Floats, rate_hz: float, nominal_s: float, *, skip_samples: int = 0) -> _Period:
    """Find the time of one revolution by correlation of the record with itself.

    ``signal``, shape (n,): record that is longer than one revolution.
    ``nominal_s``: expected time, from the programmed feed.
    ``skip_samples``: lead-in to leave out.
    Raises ``InputError`` when the record is too short to hold a revolution and something to compare.
    """
    part = signal[skip_samples:]
    low = max(2, int(nominal_s * rate_hz * (1 - _TOLERANCE)))
    longest = len(part) - max(3, int(_SHORTEST_S * rate_hz))
    high = min(int(nominal_s * rate_hz * (1 + _TOLERANCE)) + 1, longest)
    if high - low < 2:
        raise InputError(
            "the record is too short to compare one revolution with the next",
            code="align.period",
            got=f"{len(part) / rate_hz:z.2f} s after the lead-in",
            allowed=f"at least {nominal_s * (1 + _TOLERANCE) + _SHORTEST_S:z.2f} s",
        )
    lags = np.arange(low, high + 1)
    values = _self_correlation(part, lags)
    best = int(np.argmax(values))
    return _Period(int(lags[best]) + parabola_peak(values, best), float(values[best]))


def lead_in_samples(signal: Floats, rate_hz: float, period_samples: float, threshold: float = 4.5) -> int:
    """Return how many samples pass before the record repeats one revolution later.

    ``signal``, shape (n,): record.
    ``threshold``: local difference over its lowest fifth that still counts as lead-in, until a quarter of a second
    stays below it.
    """
    lag = round(period_samples)
    if len(signal) <= lag + 2:
        return 0
    local = _moving_rms(signal[lag:] - signal[:-lag], max(3, round(0.1 * rate_hz)))
    repeats = local <= threshold * np.quantile(local, 0.2)
    settle = max(1, round(0.25 * rate_hz))
    steady = np.convolve(repeats, np.ones(settle), "valid") >= settle - 0.5
    return int(np.argmax(steady)) if steady.any() else len(local)


def parabola_peak(values: Floats, best: int) -> float:
    """Return the offset of the peak of a parabola through a maximum and its neighbours."""
    if not 0 < best < len(values) - 1:
        return 0.0
    left, middle, right = values[best - 1 : best + 2].tolist()
    bend = left - 2 * middle + right
    return 0.5 * (left - right) / bend if bend < 0 else 0.0


def _self_correlation(signal: Floats, lags: NDArray[np.int64]) -> Floats:
    """Return the correlation of a record with itself some samples later, over what they share, of each lag."""
    x = signal - signal.mean()
    shared = x.size - lags
    sums, squares = (np.concatenate([[0.0], np.cumsum(v)]) for v in (x, x * x))
    first, second = sums[shared], sums[-1] - sums[lags]
    products = correlation(x, x)[x.size - 1 + lags] - first * second / shared
    spreads = (squares[shared] - first**2 / shared) * (squares[-1] - squares[lags] - second**2 / shared)
    size = np.sqrt(np.maximum(spreads, 0.0))
    # Less than rounding is a record that stands still.
    return np.divide(products, size, out=np.zeros(lags.size), where=size > _ROUNDING * squares[-1])


def _reflected(signal: Floats, margin: int) -> Floats:
    """Return the record continued by ``margin`` samples of odd reflection at both ends."""
    margin = min(margin, len(signal) - 1)
    head = 2 * signal[0] - signal[margin:0:-1]
    tail = 2 * signal[-1] - signal[-2 : -margin - 2 : -1]
    return np.concatenate([head, signal, tail])


def _above(signal: Floats, rate_hz: float, cutoff_hz: float) -> Floats:
    """Return the part of a record above a frequency, without phase shift.

    ``signal``, (n,): record; its ends are continued by reflection, so that they do not ring.
    ``rate_hz``, ``cutoff_hz``: sample rate and lowest frequency that is kept.
    """
    margin = min(len(signal) - 1, int(np.ceil(8 * rate_hz / cutoff_hz)))
    longer = _reflected(signal, margin)
    spectrum = np.fft.rfft(longer)
    spectrum[np.fft.rfftfreq(len(longer), 1 / rate_hz) < cutoff_hz] = 0.0
    return np.fft.irfft(spectrum, len(longer))[margin : margin + len(signal)]


def correlation(first: Floats, second: Floats) -> Floats:
    """Return the sums of products of two records at every shift, (n + m - 1,); the middle of an equal pair is no shift.

    As ``scipy.signal.correlate`` by its way ``fft``; to import that would take half a second of every command.
    """
    count = len(first) + len(second) - 1
    n = fft.next_fast_len(count, real=True)
    return np.asarray(fft.irfft(fft.rfft(first, n) * fft.rfft(second[::-1], n), n)[:count])


def _moving_rms(signal: Floats, n: int) -> Floats:
    """Return the root mean square under a raised-cosine window of ``n`` samples."""
    taper = np.hanning(n + 2)[1:-1]
    weight = np.convolve(np.ones(len(signal)), taper, "same")
    return np.sqrt(np.convolve(signal * signal, taper, "same") / weight)
