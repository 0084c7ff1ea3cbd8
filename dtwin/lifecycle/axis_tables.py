"""Tables of one axis over its position: LinuxCNC's and Siemens' compensation files, and CSV."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dtwin.errors import InputError
from dtwin.physics.twin import Twin
from dtwin.schema import Floats
from dtwin.train.twin_axes import axis_table_um
from dtwin.units import UM_PER_MM

MOST_TRIPLETS = 256
# SINUMERIK 808D; the larger series hold more when MD38000 says so.
SIEMENS_POINTS = 200
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
    twin: Twin,
    axis: str,
    travel_mm: tuple[float, float],
    *,
    origin_mm: float,
    points: int | None,
    speed_mm_s: float,
    most: int = MOST_TRIPLETS,
) -> AxisTable:
    """Tabulate one axis with as few rows as the tolerance allows.

    ``twin``: reduced to effects of this axis alone.
    ``axis``: X, Y or Z.
    ``travel_mm``: first and last nominal position, in the coordinates of the machine.
    ``origin_mm``: position of the centre of the measured circles in those coordinates.
    ``points``: rows; without, as many as straight lines within 0.05 um need.
    ``speed_mm_s``: usual speed; only its sign counts.
    ``most``: rows that the control holds, above 129.
    """
    low, high = travel_mm
    if not (np.isfinite([low, high]).all() and low < high):
        raise InputError(
            "the travel is empty",
            code="export.travel",
            got=f"{low:g} to {high:g} mm",
            allowed="LOW,HIGH with LOW below HIGH",
        )
    if points is not None and not 2 <= points <= most:
        raise InputError(
            "a table has too few or too many rows", code="export.points", got=str(points), allowed=f"2 to {most}"
        )
    dense = np.linspace(low, high, _CHECKED)
    truth = axis_table_um(twin, axis, dense - origin_mm, speed_mm_s)
    counts = [points] if points is not None else [2, 3, 5, 9, 17, 33, 65, 129, most]
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


def lost_motion_um(table: AxisTable) -> tuple[float, float]:
    """Return the mean of reverse minus forward, and how far one row is from it, both in um."""
    difference = table.reverse_um - table.forward_um
    mean = float(difference.mean())
    return mean, float(np.abs(difference - mean).max())


def siemens_file(table: AxisTable, said: Sequence[str]) -> str:
    """Return the leadscrew error compensation of a SINUMERIK, ``$AA_ENC_COMP``, in mm.

    A value is added to what the encoder reads, so that a positive one moves the axis backwards: it is
    the error itself, the mean of both directions. Lost motion is a machine datum, which is told in a comment.
    ``said``: comments for the head.

    Raises
    ------
    InputError
        When rows would be less than 1 um apart.
    """
    name, last = f"{table.axis}1", len(table.position_mm) - 1
    low = round(float(table.position_mm[0]), 6)
    step = round((float(table.position_mm[-1]) - low) / last, 6)
    if step < 1.0 / UM_PER_MM:
        raise InputError(
            "the rows of the table are too close together",
            code="export.step",
            got=f"{step:g} mm",
            allowed="0.001 mm or more",
            hint="--travel LOW,HIGH, --points N",
        )
    both = 0.5 * (table.forward_um + table.reverse_um) / UM_PER_MM
    lines = [
        f"%_N_{name}_EEC_INI",
        *(f"; {line}" for line in said),
        f"; before: MD38000 $MA_MM_ENC_COMP_MAX_POINTS[0,{name}] = {last + 1} or more where the series has it",
        "; (that clears memory of the control: back it up), MD32700 $MA_ENC_COMP_ENABLE[0] = 0; after: 1",
        f"; MD32450 $MA_BACKLASH[0,{name}] = {lost_motion_um(table)[0] / UM_PER_MM:z.6f}",
        "CHANDATA(1)",
        *(f"$AA_ENC_COMP[0,{n},{name}]={value:z.6f}" for n, value in enumerate(both)),
        f"$AA_ENC_COMP_STEP[0,{name}]={step:z.6f}",
        f"$AA_ENC_COMP_MIN[0,{name}]={low:z.6f}",
        f"$AA_ENC_COMP_MAX[0,{name}]={low + last * step:z.6f}",
        f"$AA_ENC_COMP_IS_MODULO[0,{name}]=0",
        "M17",
    ]
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
