"""Sensors that deliver numbers and no signal: stuck at one value, or at the end of their range."""

from __future__ import annotations

from dtwin.features.compiled import compiled
from dtwin.schema import Floats

SOUND, SATURATED = 0, 1
_RUN = 8


@compiled
def saturated_kernel(samples: Floats) -> int:
    """Return SATURATED when a signal stands at its own highest or lowest value for a while.

    A converter with 24 bits does not repeat an extreme eight times in a row unless something
    before it has reached its end. The range itself need not be known.

    Parameters
    ----------
    samples : ndarray, shape (n,)
        Newest window of one channel.
    """
    high = low = samples[0]
    for i in range(samples.shape[0]):
        high, low = max(high, samples[i]), min(low, samples[i])
    if high == low:
        return SOUND
    tops = bottoms = 0
    for i in range(samples.shape[0]):
        tops = tops + 1 if samples[i] == high else 0
        bottoms = bottoms + 1 if samples[i] == low else 0
        if tops >= _RUN or bottoms >= _RUN:
            return SATURATED
    return SOUND
