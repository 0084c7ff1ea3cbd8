"""The non-linear axis error compensation of a HEIDENHAIN control, a ``.COM`` table.

Columns ``AXISPOS`` (from the machine datum), ``BACKLASH`` (the values of the negative direction) and the axis are of the technical
manual of the NCK controls (TNC 640, 620, 320, MANUALplus 620: there page 716). From memory are the frame of the table, the sign (what is added to the command) and the number of rows.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dtwin.errors import InputError
from dtwin.lifecycle._axis_tables import BY_MEMORY, AxisForm, AxisTable, require_apart
from dtwin.units import UM_PER_MM, shown_number

# Of the TNC 407 to 425: neighbouring values differ by no more than their distance over this.
_SLOPE = 64.0


def _write(table: AxisTable, said: Sequence[str]) -> str:
    """Return a table of positions, values for the negative and for the positive direction.

    Raises ``InputError`` when rows are too close together, or neighbouring values differ by more than the control
    takes.
    """
    require_apart(table)
    rows = np.column_stack([table.position_mm, -table.reverse_um / UM_PER_MM, -table.forward_um / UM_PER_MM])
    steepest = float((np.abs(np.diff(rows[:, 1:], axis=0)) / np.diff(rows[:, :1], axis=0)).max())
    if steepest > 1.0 / _SLOPE:
        raise InputError(
            "neighbouring values differ by too much",
            code="export.slope",
            got=f"{shown_number(1000.0 * steepest)} µm in a millimetre",
            allowed=f"{shown_number(1000.0 / _SLOPE)} µm in a millimetre",
            hint="--points with fewer rows, or --travel",
        )
    lines = [
        f"BEGIN {table.axis}_AXIS.COM MM",
        *(
            f"# {line}"
            for line in (
                *said,
                BY_MEMORY,
                "From memory: values are added to the command; BACKLASH has the whole value of the negative direction.",
                "For NCK controls: TNC 640, 620, 320, MANUALplus 620. Delete these lines if refused.",
            )
        ),
        f"{'NR':<6}{'AXISPOS':<14}{'BACKLASH':<12}{table.axis:<12}",
        *(
            f"{n:<6}{at:<+z14.4f}{reverse:<+z12.4f}{forward:<+z12.4f}"
            for n, (at, reverse, forward) in enumerate(rows + 0.0)
        ),
        "[END]",
    ]
    return "\n".join(line.rstrip() for line in lines) + "\n"


def _notes(table: AxisTable) -> list[str]:
    return [
        BY_MEMORY,
        "positions are those of the machine datum; name the table in the .CMA file, and set MP_backLash to 0",
        "values are rounded to 0.1 µm",
    ]


FORM = AxisForm(_write, _notes)
