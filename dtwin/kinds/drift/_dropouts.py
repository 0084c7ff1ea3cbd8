"""Readings of temperature sensors and probes that dropped out and came back."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dtwin.schema import Floats

COLDEST_C, HOTTEST_C = -60.0, 400.0
"""No part of a machine is colder or hotter: it is what a sensor says that is not connected, such as -127, 850 or 999.9."""
# Of a sensor that drops out: how many readings tell where it would be, how far off it is, and how seldom.
_AROUND, _OFF_C, _TIMES_USUAL, _MOST_LOST = 9, 10.0, 20.0, 0.1
# Of the jump by which a sensor left: how near it comes back.
_BACK = 0.3


def possible(temperature_c: Floats) -> NDArray[np.bool_]:
    """Return which temperatures a part of a machine can have."""
    return np.asarray((temperature_c >= COLDEST_C) & (temperature_c <= HOTTEST_C))


def lost_readings(temperature_c: Floats) -> NDArray[np.bool_]:
    """Return which readings a sensor that dropped out gave: of no machine, or few and far off those before and after them, such as 85."""
    lost = np.isfinite(temperature_c) & ~possible(temperature_c)
    there = np.flatnonzero(possible(temperature_c))
    if there.size <= _AROUND:
        return lost
    read = temperature_c[there]
    steps = np.diff(read)
    limit = max(_OFF_C, _TIMES_USUAL * float(np.median(np.abs(steps))))
    few = np.abs(read - ndimage.median_filter(read, size=_AROUND, mode="nearest")) > limit
    jumps = np.flatnonzero(np.abs(steps) > limit)
    # What a sensor says instead may last longer than its neighbours tell.
    for at in jumps:
        if few[at]:
            # It is the way back.
            continue
        back = jumps[(jumps > at) & (np.abs(read[jumps + 1] - read[at]) < min(limit, _BACK * abs(steps[at])))]
        if back.size:
            few[at + 1 : back[0] + 1] = True
    if few.mean() < _MOST_LOST:
        lost[there] |= few
    return lost


def stepped(t_s: Floats, temperature_c: Floats) -> NDArray[np.intp]:
    """Return before which readings a sensor stepped, and stayed, as none of a machine does within a usual time; dropouts are NaN."""
    there = np.flatnonzero(np.isfinite(temperature_c) & np.isfinite(t_s))
    if there.size <= _AROUND:
        return there[:0]
    steps, gaps = np.abs(np.diff(temperature_c[there])), np.diff(t_s[there])
    far = steps > max(_OFF_C, _TIMES_USUAL * float(np.median(steps)))
    return there[1:][far & (gaps <= 2.0 * float(np.median(gaps)))]


def nothing_read(moved_um: Floats) -> NDArray[np.bool_]:
    """Return which readings are 0 and leave their neighbours and come back, where few do."""
    there = np.flatnonzero(np.isfinite(moved_um))
    lost = np.zeros(len(moved_um), dtype=bool)
    if there.size > _AROUND:
        read = moved_um[there]
        limit = max(1.0, _TIMES_USUAL * float(np.median(np.abs(np.diff(read)))))
        off = np.abs(read - ndimage.median_filter(read, size=_AROUND, mode="nearest")) > limit
        lost[there] = (read == 0.0) & off
    return lost if lost.mean() < _MOST_LOST else np.zeros_like(lost)
