"""Lead screw compensation of a classic Haas control, VF series, as a list to key in.

Of manual 96-8000 (June 1999): values every 0.5 inch from machine zero towards negative positions, in steps of 0.0001 inch,
at most 127 encoder steps. From memory: the sign, what is added to the command, and 138718 steps in an inch.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from dtwin.errors import InputError
from dtwin.lifecycle._axis_tables import BY_MEMORY, AxisForm, AxisTable, lost_motion_notes
from dtwin.schema import Floats
from dtwin.units import UM_PER_MM

_INCH_MM = 25.4
_SPACING_MM = 0.5 * _INCH_MM
_ENTRIES = 256
_STEPS_PER_INCH = 138718.0
_MOST_INCH = 127.0 / _STEPS_PER_INCH


def _grid(low: float, high: float, _count: int) -> Floats:
    """Return the positions of the control's own entries, from the end of the travel to machine zero."""
    entries = math.ceil(-low / _SPACING_MM - 1e-9) + 1
    if high > 1e-9 or not 2 <= entries <= _ENTRIES:
        raise InputError(
            "the travel is not that of a Haas control, which counts from machine zero to negative positions",
            code="export.travel",
            got=f"{low:g} to {high:g} mm",
            allowed=f"{-(_ENTRIES - 1) * _SPACING_MM:g} to 0 mm",
            hint="--travel LOW,0 with --origin in machine coordinates",
        )
    return -_SPACING_MM * np.arange(entries, dtype=np.float64)[::-1]


def _write(table: AxisTable, said: Sequence[str]) -> str:
    """Return entries, positions and values in inches.

    Raises ``InputError`` when a value is larger than the control takes.
    """
    trim = -0.5 * (table.forward_um + table.reverse_um) / UM_PER_MM / _INCH_MM
    # Entry 1 is machine zero, where an axis is sent to find it: nothing is corrected there.
    values = np.round(trim - trim[-1], 4)[::-1] + 0.0
    if np.abs(values).max() > _MOST_INCH:
        raise InputError(
            "a value is larger than the control takes",
            code="export.step",
            got=f"{np.abs(values).max():z.4f} inch",
            allowed=f"{_MOST_INCH:z.4f} inch: 127 encoder steps",
            hint="take the scale out with parameters 5, 19 or 33 first, or --travel",
        )
    positions = table.position_mm[::-1] / _INCH_MM + 0.0
    lines = [
        *(f"# {line}" for line in said),
        f"# {BY_MEMORY}",
        "# From memory: a value is added to the command.",
        "# Classic Haas control, VF series; to be keyed in on the page of the lead screw compensation.",
        f"# axis {table.axis}; 127 encoder steps are the limit, at {_STEPS_PER_INCH:g} steps in an inch",
        "entry,position_inch,value_inch",
        *(f"{n},{at:z.1f},{v:z.4f}" for n, (at, v) in enumerate(zip(positions, values, strict=True), start=1)),
    ]
    return "\n".join(lines) + "\n"


def _notes(table: AxisTable) -> list[str]:
    rounding = "values are rounded to 0.0001 inch, 2.54 µm; entries are every 12.7 mm, whatever --points says"
    return [BY_MEMORY, rounding, *lost_motion_notes(table, "BACKLASH of the axis")]


FORM = AxisForm(_write, _notes, _ENTRIES, _grid)
