"""Times of a log of drift, and temperatures that were read at times of their own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dtwin.acquire.time_stamps import FORMS, times_of_cells
from dtwin.errors import InputError
from dtwin.schema import Finding, Floats

_MOST_AT_ONCE = 50
"""Readings of one sample."""


def require_rising(t_s: Floats, path: Path) -> None:
    """Refuse times (n,) that hardly change, or that fall."""
    times = np.unique(t_s).size
    if t_s.size > 1 and times < max(2.0, t_s.size / _MOST_AT_ONCE):
        raise InputError(
            "the time hardly changes: how long the log took is not known",
            code="drift.clock",
            where=str(path),
            got=f"{t_s.size} readings at {times} time{'s' if times > 1 else ''}",
            allowed=f"up to {_MOST_AT_ONCE} readings at one time",
            hint="dates alone are no times: the time of day may stand in a column whose head does not say so, such as Time or Uhrzeit",
        )
    falls = np.flatnonzero(np.diff(t_s) < 0.0)
    if falls.size:
        at = int(falls[0])
        raise InputError(
            "the time does not rise",
            code="drift.clock",
            where=f"{path} reading {at + 2}",
            got=f"{t_s[at + 1] - t_s[at]:g} s after the reading before",
            allowed="readings in the order of their times",
            hint="a clock that was set back, by summer time or by hand: correct it, or part the log there",
        )


def when(t_s: Floats, which: NDArray[np.bool_]) -> str:
    """Return between which minutes of the log readings were taken."""
    told = (t_s[which] - np.nanmin(t_s)) / 60.0
    told = told[np.isfinite(told)]
    return f"from {told.min():z.0f} to {told.max():z.0f} min" if told.size else "without a time"


def seconds_of(cells: Sequence[str], unit_s: float, path: Path, head: str, *, stamps: bool) -> Floats:
    """Return times in seconds: numbers of ``unit_s``, or stamps; ``stamps``: numbers have no unit."""
    times = times_of_cells(cells, unit_s, f"{path} {head}", head, stamps=stamps)
    if times is not None:
        return times
    raise InputError(
        "times tell no unit, or are of no known form",
        code="drift.time",
        where=str(path),
        got=cells[0][:40],
        allowed=f"a head with a unit, such as time [s], time [min] or time [d]; or {FORMS}",
    )


def at_readings(
    t_s: Floats, temperatures_c: Mapping[str, Floats], displaced: NDArray[np.bool_]
) -> tuple[dict[str, Floats], list[Finding]]:
    """Return temperatures (n,) at the rows with a displacement, where all of their own readings stand in other rows, and what is said of that.

    Loggers that write a row for each sensor when it is read leave the others empty.

    ``displaced`` (n,): rows in which a displacement was read.
    """
    out, own = dict(temperatures_c), []
    for name, read in temperatures_c.items():
        there = np.isfinite(read) & np.isfinite(t_s)
        if np.count_nonzero(there) < 2 or not displaced.any() or (there & displaced).any():
            continue
        out[name] = np.where(there, read, np.interp(t_s, t_s[there], read[there], left=np.nan, right=np.nan))
        own.append(name)
    said = f"{', '.join(own)}: read in rows without a displacement, and taken to move uniformly from one reading to the next"
    return out, [Finding("drift.between", "info", said, {"columns_1": float(len(own))})] if own else []
