"""Tables of one axis over its position: LinuxCNC's compensation file, and CSV."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dtwin.errors import InputError
from dtwin.physics.twin import Twin
from dtwin.schema import Floats
from dtwin.train.twin_axes import axis_table_um
from dtwin.units import UM_PER_MM

MOST_TRIPLETS = 256
TOLERANCE_UM = 0.05
_CHECKED = 4001


@dataclass(frozen=True)
class AxisTable:
    """Error of one axis over its position.

    ``axis``: X, Y or Z.
    ``position_mm``, (n,): nominal positions in the coordinates of the machine, ascending.
    ``forward_um``, ``reverse_um``, (n,): actual minus nominal, by direction of motion; lost motion is in the
    difference.
    ``interpolation_um``: largest error of straight lines between the rows.
    """

    axis: str
    position_mm: Floats
    forward_um: Floats
    reverse_um: Floats
    interpolation_um: float


def axis_table(
    twin: Twin, axis: str, travel_mm: tuple[float, float], *, origin_mm: float, points: int | None, speed_mm_s: float
) -> AxisTable:
    """Tabulate one axis with as few rows as the tolerance allows.

    ``twin``: reduced to effects of this axis alone.
    ``axis``: X, Y or Z.
    ``travel_mm``: first and last nominal position, in the coordinates of the machine.
    ``origin_mm``: position of the centre of the measured circles in those coordinates.
    ``points``: rows; without, as many as straight lines within 0.05 um need, at most 256.
    ``speed_mm_s``: usual speed; only its sign counts.
    """
    low, high = travel_mm
    if not (np.isfinite([low, high]).all() and low < high):
        raise InputError(
            "the travel is empty",
            code="export.travel",
            got=f"{low:g} to {high:g} mm",
            allowed="LOW,HIGH with LOW below HIGH",
        )
    if points is not None and not 2 <= points <= MOST_TRIPLETS:
        raise InputError(
            "a table has too few or too many rows",
            code="export.points",
            got=str(points),
            allowed=f"2 to {MOST_TRIPLETS}",
        )
    dense = np.linspace(low, high, _CHECKED)
    truth = axis_table_um(twin, axis, dense - origin_mm, speed_mm_s)
    counts = [points] if points is not None else [2, 3, 5, 9, 17, 33, 65, 129, MOST_TRIPLETS]
    for count in counts:
        at = np.linspace(low, high, count)
        forward, reverse = axis_table_um(twin, axis, at - origin_mm, speed_mm_s)
        off = max(
            float(np.abs(np.interp(dense, at, rows) - exact).max())
            for rows, exact in zip((forward, reverse), truth, strict=True)
        )
        if off <= TOLERANCE_UM:
            break
    return AxisTable(axis, at, forward, reverse, off)


def compensation_file(table: AxisTable) -> str:
    """Return LinuxCNC's COMP_FILE of type 1: nominal, forward trim, reverse trim in mm.

    A trim is added to the command of the joint; backlash is in the difference of the two, so that
    ``BACKLASH`` of the joint must be 0.
    """
    rows = zip(table.position_mm, table.forward_um, table.reverse_um, strict=True)
    lines = [f"{p:z.6f} {0.0 - f / UM_PER_MM:z.6f} {0.0 - r / UM_PER_MM:z.6f}" for p, f, r in rows]
    return "\n".join(lines) + "\n"


def csv_table(tables: list[AxisTable]) -> str:
    """Return the tables of several axes as CSV."""
    lines = ["axis,position_mm,error_forward_um,error_reverse_um,trim_forward_mm,trim_reverse_mm"]
    for t in tables:
        rows = zip(t.position_mm, t.forward_um, t.reverse_um, strict=True)
        lines += [
            f"{t.axis},{p:z.6f},{f:z.4f},{r:z.4f},{0.0 - f / UM_PER_MM:z.7f},{0.0 - r / UM_PER_MM:z.7f}"
            for p, f, r in rows
        ]
    return "\n".join(lines) + "\n"
