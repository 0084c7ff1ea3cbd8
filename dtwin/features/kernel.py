"""The features of one window: fused moments and the sums over the spectrum."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dtwin.errors import InputError
from dtwin.features.catalogue import FEATURE_NAMES, FEATURES, positions
from dtwin.features.compiled import compiled
from dtwin.schema import Floats

VALID = 0
CONSTANT = 1
NOT_FINITE = 2

# Outside these magnitudes the fourth power of a sample leaves the range of a double.
_SMALLEST = 1e-30
_LARGEST = 1e30
# A spread below this share of the peak is rounding of a constant.
_ROUNDING = 1e-13

Codes = NDArray[np.int64]


# Sums run in two lanes: half the waiting for the previous addition, and the same order of
# additions, hence the same bits, on every processor.
@compiled
def _fold(samples: Floats) -> tuple[float, float, float, float]:
    """Return sum, sum of magnitudes, sum of squares and largest magnitude."""
    s0 = s1 = a0 = a1 = q0 = q1 = p0 = p1 = 0.0
    n = samples.shape[0]
    for i in range(n // 2):
        x0, x1 = samples[2 * i], samples[2 * i + 1]
        m0, m1 = abs(x0), abs(x1)
        s0, s1, a0, a1 = s0 + x0, s1 + x1, a0 + m0, a1 + m1
        q0, q1, p0, p1 = q0 + x0 * x0, q1 + x1 * x1, max(p0, m0), max(p1, m1)
    if n % 2:
        x0 = samples[n - 1]
        s0, a0, q0, p0 = s0 + x0, a0 + abs(x0), q0 + x0 * x0, max(p0, abs(x0))
    return s0 + s1, a0 + a1, q0 + q1, max(p0, p1)


@compiled
def _centre(samples: Floats, mean: float, centred: Floats) -> tuple[float, float, float]:
    """Write the samples minus their mean and return the sums of their 2nd to 4th powers."""
    b0 = b1 = c0 = c1 = d0 = d1 = 0.0
    n = samples.shape[0]
    for i in range(n // 2):
        x0, x1 = samples[2 * i] - mean, samples[2 * i + 1] - mean
        centred[2 * i], centred[2 * i + 1] = x0, x1
        y0, y1 = x0 * x0, x1 * x1
        b0, b1, c0, c1 = b0 + y0, b1 + y1, c0 + x0 * y0, c1 + x1 * y1
        d0, d1 = d0 + y0 * y0, d1 + y1 * y1
    if n % 2:
        x0 = samples[n - 1] - mean
        centred[n - 1] = x0
        b0, c0, d0 = b0 + x0 * x0, c0 + x0 * x0 * x0, d0 + x0 * x0 * (x0 * x0)
    return b0 + b1, c0 + c1, d0 + d1


@compiled
def _time_features(
    flat: Floats, first: int, stride: int, n: int, remove_mean: bool, centred: Floats, values: Floats, codes: Codes
) -> None:
    """Fill the time-domain features of every channel of one window.

    ``flat``, (anything,): samples; channel c of the window starts at ``first + c * stride``.
    ``n``: samples per window.
    ``remove_mean``: whether every feature is of the signal without its mean.
    ``centred``, (channels, n): receives the samples minus their mean, for the spectrum.
    ``values``, (channels, 13): receives the features in the order of the catalogue; spectral ones become 0.
    ``codes``, (channels,): receives VALID, CONSTANT or NOT_FINITE.
    """
    for c in range(values.shape[0]):
        row = values[c]
        row[:] = 0.0
        start = first + c * stride
        samples = flat[start : start + n]
        total, magnitude, squares, peak = _fold(samples)
        # A NaN anywhere makes the sum of squares a NaN, which this comparison catches.
        if not (squares <= n * _LARGEST * _LARGEST and peak <= _LARGEST):
            codes[c] = NOT_FINITE
            centred[c, :] = 0.0
            continue
        mean = total / n
        second, third, fourth = _centre(samples, mean, centred[c])
        variance = second / n
        codes[c] = VALID
        if peak <= _SMALLEST or variance <= (_ROUNDING * peak) ** 2:
            codes[c] = CONSTANT
            variance, third, fourth = 0.0, 0.0, 0.0
            centred[c, :] = 0.0
        if remove_mean:
            _, magnitude, squares, peak = _fold(centred[c])
        average = magnitude / n
        root = np.sqrt(squares / n)
        row[0], row[1], row[2], row[3], row[12] = average, variance, root, peak, squares / n
        if average > 0.0 and root > 0.0:
            row[4], row[5], row[6] = root / average, peak / average, peak / root
        if variance > 0.0:
            row[7] = fourth / n / (variance * variance)
            row[8] = third / n / (variance * np.sqrt(variance))


@compiled
def _spectral_features(
    spectrum: Floats, n: int, rate_hz: float, first_bin: int, past_bin: int, values: Floats, codes: Codes
) -> None:
    """Fill the spectral features of every channel from the transform of the centred samples.

    ``spectrum``, (channels, n // 2 + 1, 2): real and imaginary parts of the one-sided transform.
    ``values``, ``codes``: as in ``_time_features``; channels that are not VALID keep zeros.
    """
    bins = spectrum.shape[1]
    for c in range(values.shape[0]):
        if codes[c] != VALID:
            continue
        z = spectrum[c]
        t0 = t1 = w0 = w1 = highest = band = 0.0
        highest_bin = 0
        for i in range(bins // 2):
            k = 2 * i + 1
            u0, v0 = z[k, 0], z[k, 1]
            p0, p1 = u0 * u0 + v0 * v0, 0.0
            if k + 1 < bins:
                u1, v1 = z[k + 1, 0], z[k + 1, 1]
                p1 = u1 * u1 + v1 * v1
            # The bin at half the sample rate is its own mirror image.
            p0, p1 = (0.5 * p0 if 2 * k == n else p0), (0.5 * p1 if 2 * k + 2 == n else p1)
            t0, t1, w0, w1 = t0 + p0, t1 + p1, w0 + p0 * k, w1 + p1 * (k + 1)
            if p0 > highest:
                highest, highest_bin = p0, k
            if p1 > highest:
                highest, highest_bin = p1, k + 1
            if first_bin <= k < past_bin:
                band += p0
            if first_bin <= k + 1 < past_bin:
                band += p1
        total, weighted = t0 + t1, w0 + w1
        if total > 0.0:
            values[c, 9] = highest_bin * rate_hz / n
            values[c, 10] = weighted / total * rate_hz / n
            values[c, 11] = 2.0 * band / n / n


class WindowKernel:
    """Computes the features of one window of several channels, or of several windows, without allocating.

    ``n_rows``: rows of samples that are computed at once.
    ``selection``: features, in the order in which they are wanted.
    ``band_hz``: half-open band [low, high) of ``band_power``.
    ``remove_mean``: whether the mean is taken out before every feature.
    """

    def __init__(
        self,
        n_rows: int,
        n_samples: int,
        rate_hz: float,
        selection: Sequence[str],
        band_hz: tuple[float, float] | None = None,
        remove_mean: bool = False,
    ) -> None:
        self.n_samples = n_samples
        self.rate_hz = float(rate_hz)
        self.columns = np.array(positions(selection), dtype=np.int64)
        self.remove_mean = remove_mean
        self.spectral = any(FEATURES[i].spectral for i in self.columns)
        if "band_power" in selection and band_hz is None:
            raise InputError(
                "band_power needs a band",
                code="features.band",
                hint="declare band_hz = [low, high] in the window contract",
            )
        low, high = band_hz if band_hz is not None else (0.0, 0.0)
        self.first_bin = max(1, int(np.ceil(low * n_samples / self.rate_hz - 1e-9)))
        self.past_bin = int(np.ceil(high * n_samples / self.rate_hz - 1e-9))
        self._centred = np.zeros((n_rows, n_samples))
        self._spectrum = np.zeros((n_rows, n_samples // 2 + 1), dtype=np.complex128)
        self._parts = self._spectrum.view(np.float64).reshape(n_rows, -1, 2)
        self._all = np.zeros((n_rows, len(FEATURE_NAMES)))
        self._codes = np.zeros(n_rows, dtype=np.int64)

    def compute(self, flat: Floats, first: int, stride: int, out: Floats, codes: Codes) -> None:
        """Write the selected features of the samples of every row.

        ``flat``: row c starts at ``first + c * stride``.
        ``out``, (rows, n_features): receives the features; always finite.
        ``codes``, (rows,): receives the validity of each row.
        """
        n = self.n_samples
        _time_features(flat, first, stride, n, self.remove_mean, self._centred, self._all, codes)
        if self.spectral:
            np.fft.rfft(self._centred, axis=-1, out=self._spectrum)
            _spectral_features(self._parts, n, self.rate_hz, self.first_bin, self.past_bin, self._all, codes)
        np.take(self._all, self.columns, axis=1, out=out, mode="clip")
