"""Temperature sensors, and probes, that stand still to the end of a log, while others with which they moved go on."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

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
