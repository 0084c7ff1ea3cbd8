"""The leadscrew error compensation of a SINUMERIK."""

from __future__ import annotations

from collections.abc import Sequence

from dtwin.lifecycle.axis_tables import AxisForm, AxisTable, lost_motion_notes, lost_motion_um, require_apart
from dtwin.units import UM_PER_MM

# SINUMERIK 808D; the larger series hold more when MD38000 says so.
_POINTS = 200


def siemens_file(table: AxisTable, said: Sequence[str]) -> str:
    """Return the leadscrew error compensation of a SINUMERIK, ``$AA_ENC_COMP``, in mm.

    A value is added to what the encoder reads, so that a positive one moves the axis backwards (function manual of the
    808D, 01/2017, page 106): it is the error itself, the mean of both directions. Lost motion is a machine datum, which is told in a comment.
    ``said``: comments for the head.

    Raises ``InputError`` when rows would be less than 1 um apart.
    """
    require_apart(table)
    name, last = f"{table.axis}1", len(table.position_mm) - 1
    low = round(float(table.position_mm[0]), 6)
    step = round((float(table.position_mm[-1]) - low) / last, 6)
    both = 0.5 * (table.forward_um + table.reverse_um) / UM_PER_MM
    lines = [
        f"%_N_{name}_EEC_INI",
        *(f"; {line}" for line in said),
        f"; before: MD38000 $MA_MM_ENC_COMP_MAX_POINTS[0,{name}] = {last + 1} or more where the series has it",
        "; (that clears memory of the control: back it up), MD32700 $MA_ENC_COMP_ENABLE[0] = 0; after: 1",
        "; mm, for MD10240 $MN_SCALING_SYSTEM_IS_METRIC = 1",
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


def _notes(table: AxisTable) -> list[str]:
    curve, *uneven = lost_motion_notes(table, "MD32450 BACKLASH")
    return [
        f"for machine axis {table.axis}1: change the name where yours is another",
        curve,
        "the control wants 0 at the reference point: the axis moves by the value there when it is switched on",
        *uneven,
    ]


FORM = AxisForm(siemens_file, _notes, _POINTS)
