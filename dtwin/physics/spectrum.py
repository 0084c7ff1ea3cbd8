"""Strongest lines and band content of an error signal."""

from __future__ import annotations

import numpy as np

from dtwin.schema import Floats

_MOST_LINES = 5
_BANDS_HZ = ((0.0, 1.0), (1.0, 2.0), (2.0, 5.0), (5.0, 8.0), (8.0, 12.0), (12.0, 20.0), (20.0, 40.0), (40.0, 100.0))


def strongest_lines(
    signal_um: Floats, rate_hz: float
) -> tuple[list[tuple[float, float]], list[tuple[float, float, float]]]:
    """Return the strongest spectral lines and the RMS of fixed bands.

    Lines are peaks of the amplitude spectrum of the Hann-windowed signal, interpolated by a
    parabola; bands come from the plain periodogram, so that their squares add up.

    ``signal_um``, (n,): the signal, centre removed.
    Returns ``lines`` of (frequency_hz, amplitude_um), the strongest first, and ``bands`` of (from_hz, to_hz, rms_um).
    """
    n = signal_um.size
    centred = signal_um - signal_um.mean()
    window = np.hanning(n)
    amplitude = 2.0 * np.abs(np.fft.rfft(centred * window)) / window.sum()
    inner = amplitude[1:-1]
    peaks = 1 + np.flatnonzero((inner > amplitude[:-2]) & (inner >= amplitude[2:]))
    strongest = peaks[np.argsort(-amplitude[peaks])][:_MOST_LINES]
    lines = [_refined(amplitude, int(k), rate_hz / n) for k in strongest]
    return lines, _band_rms_um(signal_um, rate_hz)


def _band_rms_um(signal_um: Floats, rate_hz: float) -> list[tuple[float, float, float]]:
    """Return (from_hz, to_hz, rms_um) of each band; by Parseval their squares add up.

    ``signal_um``, (n,): the signal.
    Lower bounds are included, upper ones excluded except at half the sample rate; the mean is left out.
    """
    n = signal_um.size
    power = np.abs(np.fft.rfft(signal_um - signal_um.mean())) ** 2 * 2.0 / n**2
    if n % 2 == 0:
        power[-1] /= 2.0
    frequency = np.fft.rfftfreq(n, 1.0 / rate_hz)
    nyquist_hz = rate_hz / 2.0
    bands = []
    for low, high in _BANDS_HZ:
        top = min(high, nyquist_hz)
        below = frequency <= top if top == nyquist_hz else frequency < top
        if low < nyquist_hz:
            bands.append((low, top, float(np.sqrt(power[(frequency >= low) & below].sum()))))
    return bands


def _refined(amplitude: Floats, k: int, step_hz: float) -> tuple[float, float]:
    before, peak, after = amplitude[k - 1], amplitude[k], amplitude[k + 1]
    curve = before - 2.0 * peak + after
    shift = 0.5 * (before - after) / curve if curve else 0.0
    return float((k + shift) * step_hz), float(peak - 0.25 * (before - after) * shift)
