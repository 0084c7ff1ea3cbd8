"""Wrist minus base, refused where the base does not see the same motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dtwin.errors import InputError
from dtwin.features.spectrum import segment_spectra
from dtwin.schema import Floats

_MIN_SEGMENTS = 4


@dataclass(frozen=True)
class RelativeMotion:
    """Outcome of a subtraction.

    Attributes
    ----------
    signal : ndarray, shape (n,)
        Wrist minus base where that was allowed, else the wrist as it is.
    subtracted : bool
        Whether the base was subtracted.
    coherence : float
        Magnitude-squared coherence in the band, weighted by the power of the wrist.
    gain : float
        Least-squares gain from base to wrist in the band; 1 for a rigid common motion.
    reason : str
        Why it was not subtracted; empty when it was.
    """

    signal: Floats
    subtracted: bool
    coherence: float
    gain: float
    reason: str = ""


def coherence(first: Floats, second: Floats, rate_hz: float, n_segment: int = 256) -> tuple[Floats, Floats]:
    """Return frequencies and magnitude-squared coherence of two records.

    Averages over half-overlapping Hann segments (Carter, Knapp and Nuttall, IEEE Trans.
    Audio Electroacoust. 21, 1973).

    Parameters
    ----------
    first, second : ndarray, shape (n,)
        Records on one clock.
    rate_hz : float
        Sample rate.
    n_segment : int
        Samples per segment.

    Raises
    ------
    InputError
        When the records differ in length or hold fewer than four segments: the coherence of
        one segment is 1 whatever the signals are.
    """
    if len(first) != len(second):
        raise InputError(
            "the two records differ in length", code="relative.length", got=f"{len(first)} and {len(second)} samples"
        )
    if len(first) < n_segment // 2 * (_MIN_SEGMENTS + 1):
        raise InputError(
            "the record is too short for a coherence",
            code="relative.short",
            got=f"{len(first)} samples",
            allowed=f"at least {n_segment // 2 * (_MIN_SEGMENTS + 1)}",
        )
    a, b = segment_spectra(first, n_segment), segment_spectra(second, n_segment)
    cross = np.abs((a.conj() * b).mean(axis=0)) ** 2
    power = (np.abs(a) ** 2).mean(axis=0) * (np.abs(b) ** 2).mean(axis=0)
    value: Floats = np.divide(cross, power, out=np.zeros_like(cross), where=power > 0)
    return np.asarray(np.fft.rfftfreq(n_segment, 1 / rate_hz), dtype=np.float64), value


def wrist_minus_base(
    wrist: Floats,
    base: Floats,
    rate_hz: float,
    band_hz: tuple[float, float],
    min_coherence: float = 0.5,
    n_segment: int = 256,
) -> RelativeMotion:
    """Subtract the base's acceleration where it is the same motion that the wrist sees.

    Subtracting an unrelated signal adds its noise; so the base is subtracted only when the
    coherence in the band is high and the difference is quieter there than the wrist alone.

    Parameters
    ----------
    wrist, base : ndarray, shape (n,)
        Accelerations in the same unit and direction, on one clock.
    rate_hz : float
        Sample rate.
    band_hz : tuple of float
        Band in which the two must agree.
    min_coherence : float
        Smallest coherence at which a subtraction is allowed.

    Raises
    ------
    InputError
        When the records differ in length or are too short.
    """
    frequency_hz, value = coherence(wrist, base, rate_hz, n_segment)
    band = (frequency_hz >= band_hz[0]) & (frequency_hz < band_hz[1])
    if not band.any():
        raise InputError(
            "no spectral line lies in the band",
            code="relative.band",
            got=f"{band_hz[0]} to {band_hz[1]} Hz at {rate_hz / n_segment:.3g} Hz per line",
            hint="widen the band or lengthen the segments",
        )
    w = segment_spectra(wrist, n_segment)[:, band]
    b = segment_spectra(base, n_segment)[:, band]
    weight = (np.abs(w) ** 2).mean(axis=0)
    shared = float(np.sum(weight * value[band]) / weight.sum()) if weight.sum() > 0 else 0.0
    energy = float(np.sum(np.abs(b) ** 2))
    gain = float(np.sum((b.conj() * w).real)) / energy if energy > 0 else 0.0
    quieter = np.sum(np.abs(w - b) ** 2) < np.sum(np.abs(w) ** 2)
    if shared < min_coherence:
        reason = f"coherence {shared:z.2f} is below {min_coherence:z.2f}"
    elif not quieter:
        reason = f"the difference is louder than the wrist alone (gain {gain:z.2f})"
    else:
        return RelativeMotion(wrist - base, True, shared, gain)
    return RelativeMotion(wrist.copy(), False, shared, gain, reason)
