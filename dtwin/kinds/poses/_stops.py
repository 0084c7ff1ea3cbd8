"""Joints that were logged beside the instrument: each reading at a stop takes the joints of that stop.

``condition = { joints_log = "joint_states.csv" }`` of a run names the log; both files tell the time by one clock.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dtwin.errors import InputError
from dtwin.schema import Floats

# A stop: joints stand still within so much, over so long on both sides of a reading.
_STILL_DEG, _AROUND_S = 0.02, 0.2
_LONGEST_GAP_S = 2.0


def with_joints(
    table: Mapping[str, Floats], log: Mapping[str, Floats], where: Path
) -> tuple[dict[str, Floats], NDArray[np.bool_]]:
    """Return readings with the joints at which they were taken, one a stop, and which rows of the table are in none.

    Readings of one stop are no repeats: their mean is one.

    ``table``: columns of readings (n,) with ``t_s``.
    ``log``: columns ``joint_1_deg`` … (m,) with ``t_s``.
    ``where``: file of the log, for error messages.
    """
    names = sorted((n for n in log if n.startswith("joint_")), key=lambda n: int(n.split("_")[1]))
    if "t_s" not in log or not names or "t_s" not in table:
        raise InputError(
            "joints and readings cannot be brought together",
            code="poses.joints_log",
            where=str(where),
            got=f"log: {', '.join(log)}; readings: {', '.join(table)}"[:200],
            allowed="t_s in both files, by one clock, and joint_1_deg … in the log",
        )
    good = np.isfinite(np.stack([log["t_s"], *(log[n] for n in names)])).all(axis=0)
    order = np.argsort(log["t_s"][good], kind="stable")
    t_s = log["t_s"][good][order]
    joints = np.stack([log[n][good][order] for n in names], axis=1)
    at = table["t_s"]
    held = np.full((len(at), len(names)), np.nan)
    first, last = np.searchsorted(t_s, at - _AROUND_S), np.searchsorted(t_s, at + _AROUND_S)
    for row in np.flatnonzero((last - first >= 2) & np.isfinite(at)):
        near = slice(int(first[row]), int(last[row]))
        # Before the reading, and behind it.
        around = t_s[near.start] <= at[row] <= t_s[near.stop - 1]
        if around and np.ptp(joints[near], axis=0).max() <= _STILL_DEG:
            held[row] = joints[near].mean(axis=0)
    still = np.isfinite(held).all(axis=1)
    if not still.any():
        raise InputError(
            "no reading was taken while the robot stood",
            code="poses.stops",
            where=str(where),
            got=f"readings from {np.nanmin(at):z.3f} to {np.nanmax(at):z.3f} s, joints from {t_s[0]:z.3f} to {t_s[-1]:z.3f} s"
            if len(t_s)
            else "no joints",
            allowed=f"stops of {2.0 * _AROUND_S:g} s and more, by one clock",
        )
    return _stops(table, held, still, names), ~still


def _stops(table: Mapping[str, Floats], held: Floats, still: NDArray[np.bool_], names: list[str]) -> dict[str, Floats]:
    """Return the mean of every stretch of readings between two motions."""
    rows = np.flatnonzero(still)
    rows = rows[np.argsort(table["t_s"][rows], kind="stable")]
    moved = np.abs(np.diff(held[rows], axis=0)).max(axis=1) > _STILL_DEG
    apart = np.diff(table["t_s"][rows]) > _LONGEST_GAP_S
    label = np.concatenate([[0], np.cumsum(moved | apart)])
    count = np.bincount(label)
    columns = {name: values[rows] for name, values in table.items()}
    columns |= {name: held[rows, n] for n, name in enumerate(names)}
    return {name: np.bincount(label, values) / count for name, values in columns.items()}
