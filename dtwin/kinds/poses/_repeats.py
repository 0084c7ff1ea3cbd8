"""Measured places without commanded ones, read again and again: how poses repeat, and no accuracy.

``condition = { joints_log = "joint_states.csv" }`` of a run names the log: both files tell the time by one clock, or the log has no times and a
row for each row of the table.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dtwin.acquire.foreign_columns import below_heads, columns_of
from dtwin.acquire.xmlsafe import number_or_none
from dtwin.errors import InputError
from dtwin.schema import Floats
from dtwin.units import UM_PER_MM, shown_number

_MOST_TITLES = 12
COUNTS = re.compile(
    r"(repeat|repetition|cycle|run|trial|approach|reading|wiederholung|zyklus|messung|anfahrt|lauf)([\s_.]*(no|nr|number|nummer|#))?\.?",
    re.I,
)
PLACES = re.compile(
    r"(pose|point|punkt|position|target|reflector|reflektor|smr|ziel)([\s_.]*(no|nr|number|nummer|id|name|#))?\.?", re.I
)
_AXIS = re.compile(r"(?:measured_|meas_|actual_|ist_|position_|pos_)?([xyz])_(mm|um)")
_FEWEST = 3
_SHOWN = 4
# Of a path successive places lie nearer to each other than to its middle, which repeats do not.
_PATH_STEP = 0.2
_TRACKED = re.compile(r"//\s*AXES = CARTESIAN: X,\s*Y,\s*Z \((\w+)\)")
_WHOLE = re.compile(r"[+-]?\d+")


def with_tracker_heads(rows: Sequence[Sequence[str]]) -> Sequence[Sequence[str]]:
    """Return points that SpatialAnalyzer exported with heads above, by its remark ``// AXES = CARTESIAN: X, Y, Z (mm)``; another table as it is."""
    told = ((n, _TRACKED.match(",".join(row))) for n, row in enumerate(rows[:_MOST_TITLES]))
    begin, said = next(((n, heads_there) for n, heads_there in told if heads_there), (0, None))
    if said is None or len(rows) < begin + 2:
        return rows
    cells = [cell.strip() for cell in rows[begin + 1]]
    last = max((n for n, cell in enumerate(cells) if number_or_none(cell) is not None), default=0)
    if last < 2:
        return rows
    heads = [""] * (last - 2) + [f"{axis} [{said[1]}]" for axis in "XYZ"] + [""] * (len(cells) - last - 1)
    # Group, point and number of the reading: a point may be called by a number, too.
    counted = last > 4 and _WHOLE.fullmatch(cells[last - 3]) is not None
    if last > 2:
        heads[last - 3 - counted] = "point"
    if counted:
        heads[last - 3] = "reading"
    return [heads, *rows[begin + 1 :]]


def repeated_places(rows: Sequence[Sequence[str]]) -> Mapping[str, Floats]:
    """Return the readings (n, 3) in mm of each place of a table of measured X, Y and Z alone, with the number of the repeat or the place's name; else nothing."""
    for begin, row in enumerate(rows[:_MOST_TITLES]):
        heads = [cell.strip() for cell in row]
        if not any(COUNTS.fullmatch(head) or PLACES.fullmatch(head) for head in heads):
            continue
        units, body = below_heads([list(line) for line in rows], begin)
        matches = [_AXIS.fullmatch(column.name) for column in columns_of(heads, units, {})]
        axes = {match[1]: n for n, match in enumerate(matches) if match}
        others = [h for h, match in zip(heads, matches, strict=True) if h and not match]
        known = all(COUNTS.fullmatch(h) or PLACES.fullmatch(h) for h in others)
        if len(axes) != 3 or sum(map(bool, matches)) != 3 or not known:
            return {}
        scale = [1.0 / UM_PER_MM if matches[axes[a]][2] == "um" else 1.0 for a in "xyz"]  # type: ignore[index]
        factors = [columns_of(heads, units, {})[axes[a]].factor for a in "xyz"]
        place = next((n for n, h in enumerate(heads) if PLACES.fullmatch(h)), None)
        told: dict[str, list[list[float]]] = {}
        for line in body:
            values = [number_or_none(line[axes[a]]) if axes[a] < len(line) else None for a in "xyz"]
            name = line[place].strip() if place is not None and place < len(line) else ""
            if None not in values:
                told.setdefault(name, []).append([v * s * f for v, s, f in zip(values, scale, factors, strict=True)])  # type: ignore[operator]
        read = {name: np.array(points) for name, points in told.items() if len(points) >= _FEWEST}
        return {name: points for name, points in read.items() if not _is_path(points)}
    return {}


def _is_path(points: Floats) -> bool:
    """Return whether places (n, 3) follow a path, as of a tracker that recorded a motion."""
    step = np.linalg.norm(np.diff(points, axis=0), axis=1).mean()
    return bool(step < _PATH_STEP * np.linalg.norm(points - points.mean(axis=0), axis=1).mean())


def no_commanded(path: Path, places: Mapping[str, Floats]) -> InputError:
    """Return the refusal of places that nobody says where they should be, with the repeatability of ISO 9283."""
    told = []
    for name, points in places.items():
        off = np.linalg.norm(points - points.mean(axis=0), axis=1)
        rp = float(off.mean() + 3.0 * off.std(ddof=1))
        told.append((rp, f"RP {shown_number(rp)} mm of {len(points)} readings" + f" of {name}" * bool(name)))
    worst = [text for _, text in sorted(told, reverse=True)[:_SHOWN]]
    return InputError(
        "the table tells where poses were measured, not where they were commanded: how they repeat, and no accuracy",
        code="poses.commanded",
        where=str(path),
        got="; ".join(worst),
        allowed="commanded places beside: Target X [mm], Target Y [mm], Target Z [mm]",
        hint="the repeatability of ISO 9283 is what is got, the largest first; the standard asks for thirty readings, each after a motion",
    )


# A stop: joints stand still within so much, over so long on both sides of a reading.
_STILL_DEG, _AROUND_S = 0.02, 0.2
_LONGEST_GAP_S = 2.0


def with_joints(
    table: Mapping[str, Floats], log: Mapping[str, Floats], where: Path
) -> tuple[dict[str, Floats], NDArray[np.bool_]]:
    """Return readings with the joints at which they were taken, one a stop, and which rows of the table are in none.

    Readings of one stop are no repeats: their mean is one. A log without times has a row for each reading.

    ``table``: columns of readings (n,), with ``t_s`` where the log has it.
    ``log``: columns ``joint_1_deg`` … (m,), mostly with ``t_s``.
    ``where``: file of the log, for error messages.
    """
    names = sorted((n for n in log if n.startswith("joint_")), key=lambda n: int(n.split("_")[1]))
    rows, logged = (len(next(iter(columns.values()), ())) for columns in (table, log))
    if names and "t_s" not in log and rows in (logged, 0):
        return {**table, **{n: log[n] for n in names}}, np.zeros(logged, bool)
    if "t_s" not in log or not names or "t_s" not in table:
        raise InputError(
            "joints and readings cannot be brought together",
            code="poses.joints_log",
            where=str(where),
            got=f"log: {', '.join(log) or 'nothing known'} in {logged} rows; readings: {', '.join(table) or 'nothing known'} in {rows} rows"[
                :240
            ],
            allowed="t_s in both files, by one clock, and joint_1_deg … in the log; or a log without times that has a row for each reading",
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
