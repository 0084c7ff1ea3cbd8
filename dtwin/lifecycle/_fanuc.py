"""Stored pitch error compensation of FANUC Series 16i, 18i, 21i, 0i-A to 0i-C, and of 30i, 31i, 32i, 0i-D, 0i-F; steps of 1 um (IS-B).

Of the parameter manuals: numbers 3620 to 3624 and 1851, 128 points an axis, steps of -7 to 7 times the magnification, each
the change since the point before as seen from the negative side; point n is of the section that ends there (Series 0i-PB,
B-63980EN, page 100). From memory: that a step is added to the command, the blocks ``N10000`` of the data, that the 30i marks
parameters with ``Q1`` and these data with ``Q0``, and that its 3624 is a number of mm with a point, as its other lengths are.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

import numpy as np

from dtwin.errors import InputError
from dtwin.lifecycle._axis_tables import BY_MEMORY, AxisForm, AxisTable, lost_motion_notes, lost_motion_um
from dtwin.schema import Floats
from dtwin.units import UM_PER_MM, shown_number

_POINTS, _STEP, _MAGNIFICATION, _BACKLASH = 128, 7, 100, 9999
_AXES = "XYZ"
# A control without the option that interpolates puts a whole step in at once: of one increment, where points suffice.
_HELD_UM = 1.0
# Largest feed in mm/min over the smallest interval in mm.
_FEED_PER_MM = 7500.0


def _grid(low: float, high: float, count: int) -> Floats:
    """Return positions a whole number of intervals from the reference position, machine zero, which is among them."""
    low, high = min(low, 0.0), max(high, 0.0)
    interval_um = math.ceil((high - low) * UM_PER_MM / max(count - 3, 1))
    first, last = (round(f(end * UM_PER_MM / interval_um)) for f, end in ((math.floor, low), (math.ceil, high)))
    return np.arange(first, last + 1) * interval_um / UM_PER_MM


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
        got=f"{shown_number(np.abs(np.diff(trim)).max())} µm",
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
        3624: f"{interval_um / UM_PER_MM:z.3f}" if marked else interval_um,
    }
    series = "30i, 31i, 32i, 0i-D, 0i-F; not 16i" if marked else "16i, 18i, 21i, 0i-A to 0i-C; not 30i"
    parameter, datapoint = ("Q1", "Q0") if marked else ("", "")
    lines = [
        *said,
        BY_MEMORY,
        "From memory: steps are added to the command, and the blocks N1....",
        f"FANUC Series {series}. Metric (1001#0 = 0). Detection unit and least input increment 1 um; reference at machine zero.",
        "%",
        *(f"N{number:05d}{parameter}A{axis}P{value}" for number, value in datum.items()),
        *(f"N{10000 + first + n:05d}{datapoint}P{step}" for n, step in enumerate(steps, start=1)),
        "%",
    ]
    return "\n".join(lines) + "\n"


def _notes(table: AxisTable) -> list[str]:
    steps, magnification, _ = _steps(table)
    apart_mm = float(table.position_mm[1] - table.position_mm[0])
    largest = magnification * max(map(abs, steps))
    return [
        BY_MEMORY,
        f"values are rounded to {magnification} µm; a control that does not interpolate puts in up to {largest} µm at once",
        f"points are {apart_mm:g} mm apart: enough for feeds, rapid ones too, up to {_FEED_PER_MM * apart_mm:z.0f} mm/min "
        f"(over {_FEED_PER_MM:g}, from memory); --points with fewer for more",
        *lost_motion_notes(table, "1851"),
        "the number of the axis, and those of the points, are ours: change them where the machine has others",
    ]


FORM = AxisForm(_write, _notes, _POINTS, _grid, held_um=_HELD_UM)
FORM_30I = AxisForm(partial(_write, marked=True), _notes, _POINTS, _grid, held_um=_HELD_UM)
