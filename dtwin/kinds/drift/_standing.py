"""Readings that dropped out and came back; temperature sensors, and probes, that stand still to the end of a log, while others with which they moved go on."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dtwin.schema import Finding, Floats

_FEWEST, _LEAST_SHARE = 20, 0.05
_TIMES_BEFORE = 3
"""Times as long as ever before a sensor stands that is suspect."""
_STEPS, _LEAST_K = 10.0, 0.5
"""How far it should have moved meanwhile, in steps of its display, and at least."""
_POWER_ON_C = 85.0
_FAR_C = 10.0
_OF_RANGE = 0.2
"""Of its range, how far a temperature goes while a probe stands that is suspect."""


def standing(t_s: Floats, temperatures_c: Mapping[str, Floats]) -> Iterator[Finding]:
    """Yield a finding for each sensor that is suspect; nothing is left out.

    ``t_s`` (n,), ``temperatures_c`` (n,) each: as they were read, NaN where nothing was.
    """
    for name, read in temperatures_c.items():
        there = np.flatnonzero(np.isfinite(read) & np.isfinite(t_s))
        if there.size < _FEWEST:
            continue
        changes = np.flatnonzero(np.diff(read[there])) + 1
        begin = int(changes[-1]) if changes.size else 0
        stands = there[begin:]
        if stands.size < max(_FEWEST, _LEAST_SHARE * there.size):
            continue
        value = float(read[there[-1]])
        minutes = (t_s[[stands[0], there[-1]]] - t_s[there[0]]) / 60.0
        other = _moves_on(name, there[:begin], stands, changes, temperatures_c)
        power_on = value == _POWER_ON_C and all(
            abs(float(np.nanmax(of)) - value) > _FAR_C for key, of in temperatures_c.items() if key != name
        )
        if not other and not power_on:
            continue
        said = f"{name} stands at {value:g} °C from {minutes[0]:z.0f} to {minutes[1]:z.0f} min, the end of the log"
        said += f", while {other} moves on, with which it moved before" if other else ""
        said += (
            ": it is what a DS18B20 says when its power was gone"
            if power_on
            else ": a sensor that is stuck or came off"
        )
        said += '; what follows from it is suspect: leave it out ("HEAD" = "" in [campaign.instrument.columns]), or end the log there'
        yield Finding("drift.sensor_stands", "warning", said, {"readings_1": float(stands.size)})


def probe_standing(moved_um: Floats, temperatures_c: Sequence[Floats]) -> list[Finding]:
    """Return a finding where a displacement shows one value to the end of the log, as never before, while temperatures move on.

    ``moved_um``, ``temperatures_c`` (n,) each: as they were read.
    """
    changes = np.flatnonzero(np.diff(moved_um)) + 1
    begin = int(changes[-1]) if changes.size else 0
    size = len(moved_um) - begin
    longest = float(np.diff(changes, prepend=0.0).max()) if changes.size else np.inf
    if size < max(_FEWEST, _LEAST_SHARE * len(moved_um)) or _TIMES_BEFORE * longest > size:
        return []
    if not any(np.ptp(read[begin:]) > max(_OF_RANGE * float(np.ptp(read)), _LEAST_K) for read in temperatures_c):
        return []
    said = (
        f"the displacement stands at {moved_um[-1]:z.6g} µm for the last {size} readings, while temperatures move on: a probe that lost its target, is at "
        "the end of its range or was not read; end the log there"
    )
    return [Finding("drift.probe_stands", "warning", said, {"readings_1": float(size)})]


def _moves_on(
    name: str,
    before: NDArray[np.intp],
    stands: NDArray[np.intp],
    changes: NDArray[np.intp],
    temperatures_c: Mapping[str, Floats],
) -> str:
    """Return a sensor that goes on by as much as would show in one that stands; empty where none does, or it stood as long before."""
    longest = float(np.diff(changes, prepend=0.0).max()) if changes.size else np.inf
    if before.size < _FEWEST or _TIMES_BEFORE * longest > stands.size:
        return ""
    read = temperatures_c[name]
    steps = np.abs(np.diff(read[before]))
    least = max(_STEPS * float(steps[steps > 0.0].min(initial=np.inf)), _LEAST_K)
    for other, of in temperatures_c.items():
        if other == name or not np.isfinite(of[before]).any() or not np.isfinite(of[stands]).any():
            continue
        earlier, later = (float(np.nanmax(of[at]) - np.nanmin(of[at])) for at in (before, stands))
        if earlier > 0.0 and float(np.ptp(read[before])) * later / earlier > least:
            return other
    return ""


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
