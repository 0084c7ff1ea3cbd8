"""Sensors that deliver numbers and no signal: at the end of their range."""

from __future__ import annotations

from dtwin.features.compiled import compiled
from dtwin.schema import Floats

SOUND, SATURATED = 0, 1
_FEWEST, _SHARE = 8, 0.05


@compiled
def saturated_kernel(samples: Floats) -> int:
    """Return SATURATED when a signal stands at its own highest or lowest value too often.

    Neither noise nor a sine of a hundred steps or more has a twentieth of its samples at exactly
    one extreme; a signal that was cut at the end of a range has. The range need not be known.
    Rare peaks that are cut are not found.

    ``samples``, (n,): newest window of one channel.
    """
    n = samples.shape[0]
    high = low = samples[0]
    tops = bottoms = 0
    for i in range(n):
        x = samples[i]
        if x > high:
            high, tops = x, 0
        if x < low:
            low, bottoms = x, 0
        tops += 1 if x == high else 0
        bottoms += 1 if x == low else 0
    if high == low:
        return SOUND
    return SATURATED if max(tops, bottoms) >= max(_FEWEST, _SHARE * n) else SOUND
