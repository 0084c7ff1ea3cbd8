"""Features of one window of several channels, by the kernel that a serving host runs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dtwin.features.catalogue import FEATURE_NAMES
from dtwin.features.kernel import WindowKernel


def window_features(
    block: np.ndarray,
    rate_hz: float,
    selection: Sequence[str] = FEATURE_NAMES,
    band_hz: tuple[float, float] | None = None,
    remove_mean: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    samples = np.ascontiguousarray(block, dtype=np.float64)
    channels, n = samples.shape
    kernel = WindowKernel(channels, n, rate_hz, selection, band_hz, remove_mean)
    values, codes = np.zeros((channels, len(selection))), np.zeros(channels, dtype=np.int64)
    kernel.compute(samples.reshape(-1), 0, n, values, codes)
    return values, codes
