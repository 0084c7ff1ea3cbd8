"""Whole-record spectral tools that alignment, relative motion and integration share."""

from __future__ import annotations

import numpy as np
from scipy import fft

from dtwin.schema import Floats


def _reflected(signal: Floats, margin: int) -> Floats:
    """Return the record continued by ``margin`` samples of odd reflection at both ends."""
    margin = min(margin, len(signal) - 1)
    head = 2 * signal[0] - signal[margin:0:-1]
    tail = 2 * signal[-1] - signal[-2 : -margin - 2 : -1]
    return np.concatenate([head, signal, tail])


def above(signal: Floats, rate_hz: float, cutoff_hz: float) -> Floats:
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


def moving_rms(signal: Floats, n: int) -> Floats:
    """Return the root mean square under a raised-cosine window of ``n`` samples."""
    taper = np.hanning(n + 2)[1:-1]
    weight = np.convolve(np.ones(len(signal)), taper, "same")
    return np.sqrt(np.convolve(signal * signal, taper, "same") / weight)
