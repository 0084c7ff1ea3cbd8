"""Stored pitch error compensation of FANUC Series 16i, 18i, 21i and 0i, and of 30i, 31i, 32i; increments of 1 µm (IS-B).

Of the parameter manuals: numbers 3620 to 3624 and 1851, 128 points an axis, steps of -7 to 7 times the magnification, each
the change since the point before as seen from the negative side. From memory: the blocks ``N10000`` of the data, and that the
30i marks parameters with ``Q1`` and these data with ``Q0``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

import numpy as np

from dtwin.errors import InputError
from dtwin.lifecycle.axis_tables import BY_MEMORY, AxisForm, AxisTable, lost_motion_notes, lost_motion_um
from dtwin.schema import Floats
from dtwin.units import UM_PER_MM

_POINTS, _STEP, _MAGNIFICATION, _BACKLASH = 128, 7, 100, 9999
_AXES = "XYZ"


def _grid(low: float, high: float, count: int) -> Floats:
    """Return positions a whole number of intervals from the reference position, machine zero, which is among them."""
    low, high = min(low, 0.0), max(high, 0.0)
    interval_um = math.ceil((high - low) * UM_PER_MM / max(count - 3, 1))
    first, last = (round(f(end * UM_PER_MM / interval_um)) for f, end in ((math.floor, low), (math.ceil, high)))
    positions: Floats = np.arange(first, last + 1) * interval_um / UM_PER_MM
    return positions


def _steps(table: AxisTable) -> tuple[list[int], int, int]:
    """Return the steps, their magnification, and which row is the reference position."""
    reference = int(np.abs(table.position_mm).argmin())
    trim = -0.5 * (table.forward_um + table.reverse_um)
    trim = trim - trim[reference]
    for magnification in range(1, _MAGNIFICATION + 1):
        steps = np.diff(np.round(trim / magnification).astype(int))
        if np.abs(steps).max() <= _STEP:
            return steps.tolist(), magnification, reference
    raise InputError(
        "the error changes by more between two rows than the control takes",
        code="export.step",
        got=f"{np.abs(np.diff(trim)).max():.3g} µm",
        allowed=f"{_STEP * _MAGNIFICATION} µm",
        hint="--points with more rows, up to 128",
    )


def _write(table: AxisTable, said: Sequence[str], *, marked: bool = False) -> str:
    """Return parameters and data; what stands before the first ``%`` is skipped by the control.

    Raises ``InputError`` when a step or the backlash is larger than the control takes.
    """
    steps, magnification, reference = _steps(table)
    backlash = round(lost_motion_um(table)[0])
    if abs(backlash) > _BACKLASH:
        raise InputError("the lost motion is larger than parameter 1851", code="export.step", got=f"{backlash} µm")
    axis = _AXES.index(table.axis) + 1
    first = _POINTS * (axis - 1)
    interval_um = round(float(table.position_mm[1] - table.position_mm[0]) * UM_PER_MM)
    datum = {
        1851: backlash,
        3620: first + reference,
        3621: first + 1,
        3622: first + len(steps),
        3623: magnification,
        3624: interval_um,
    }
    series = "30i, 31i, 32i; not 16i" if marked else "16i, 18i, 21i, 0i; not 30i"
    parameter, datapoint = ("Q1", "Q0") if marked else ("", "")
    lines = [
        *said,
        BY_MEMORY,
        f"FANUC Series {series}. Detection unit and least input increment 1 um; reference at machine zero.",
        "%",
        *(f"N{number:05d}{parameter}A{axis}P{value}" for number, value in datum.items()),
        *(f"N{10000 + first + n:05d}{datapoint}P{step}" for n, step in enumerate(steps, start=1)),
        "%",
    ]
    return "\n".join(lines) + "\n"


def _notes(table: AxisTable) -> list[str]:
    _, magnification, _ = _steps(table)
    return [
        BY_MEMORY,
        f"values are rounded to {magnification} µm; between two points the control may put a whole step in at once",
        f"points are {table.position_mm[1] - table.position_mm[0]:g} mm apart: the control wants the largest feed in mm/min "
        "over 7500, or more (from memory)",
        *lost_motion_notes(table, "1851"),
        "the number of the axis, and those of the points, are ours: change them where the machine has others",
    ]


FORM = AxisForm(_write, _notes, _POINTS, _grid)
FORM_30I = AxisForm(partial(_write, marked=True), _notes, _POINTS, _grid)
