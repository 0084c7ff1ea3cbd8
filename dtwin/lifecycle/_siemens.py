"""The leadscrew error compensation of a SINUMERIK, and its sag and angularity error compensation, ``$AN_CEC``.

Of the function manual K3 (840D sl, 828D): the names of the variables, that a table is of set positions of a base axis, that the
ends are held, that ``DIRECTION`` limits it to one direction, 200 points in each of 8 tables on an 828D. From memory: that
the values are added to the set position of the other axis.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dtwin.lifecycle._axis_tables import (
    BY_MEMORY,
    AxisForm,
    AxisTable,
    lost_motion_notes,
    lost_motion_um,
    require_apart,
)
from dtwin.schema import Floats
from dtwin.units import UM_PER_MM

# SINUMERIK 808D; the larger series hold more when MD38000 says so.
_POINTS = 200


def _siemens_file(table: AxisTable, said: Sequence[str]) -> str:
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


FORM = AxisForm(_siemens_file, _notes, _POINTS)


_CEC_POINTS = 200
_TABLES_OF_AN_AXIS = 4
_AXES = "XYZ"


def _write(table: AxisTable, said: Sequence[str]) -> str:
    """Return one table for each direction of the axis, and one for each other axis that it leans with, in mm.

    ``said``: comments for the head.

    Raises ``InputError`` when rows would be less than 1 um apart.
    """
    first = _TABLES_OF_AN_AXIS * _AXES.index(table.axis)
    parts = [(table, table.forward_um, 1), (table, table.reverse_um, -1)]
    parts += [(other, other.forward_um, 0) for other in table.across]
    lines = [
        "%_N_NC_CEC_INI",
        *(f"; {line}" for line in said),
        f"; {BY_MEMORY}",
        *_before(table, [first + n for n in range(len(parts))], [len(part.position_mm) for part, _, _ in parts]),
        "CHANDATA(1)",
    ]
    for number, (part, error_um, direction) in enumerate(parts, start=first):
        lines += _one(part, error_um, direction, number)
    return "\n".join([*lines, "M17"]) + "\n"


def _before(table: AxisTable, numbers: Sequence[int], counts: Sequence[int]) -> list[str]:
    name = f"{table.axis}1"
    points = ", ".join(f"[{n}] = {count}" for n, count in zip(numbers, counts, strict=True))
    return [
        "; mm, for MD10240 $MN_SCALING_SYSTEM_IS_METRIC = 1; from memory: values are added to the set position",
        f"; before: MD18342 $MN_MM_CEC_MAX_POINTS{points} or more where the series has it (that clears memory: back it up),",
        f"; $SN_CEC_TABLE_ENABLE = 0; after: 1 for each table, MD32710 $MA_CEC_ENABLE[{name}] = 1",
        f"; MD32720 $MA_CEC_MAX_SUM[{name}] must hold {_largest_mm(table):z.6f} mm; MD32450 $MA_BACKLASH[0,{name}] = 0",
    ]


def _largest_mm(table: AxisTable) -> float:
    own = max(np.abs(table.forward_um).max(), np.abs(table.reverse_um).max())
    return float(own + sum(np.abs(other.forward_um).max() for other in table.across)) / UM_PER_MM


def _one(table: AxisTable, error_um: Floats, direction: int, number: int) -> list[str]:
    require_apart(table)
    last = len(table.position_mm) - 1
    low = round(float(table.position_mm[0]), 6)
    step = round((float(table.position_mm[-1]) - low) / last, 6)
    return [
        *(f"$AN_CEC[{number},{n}]={value:z.6f}" for n, value in enumerate(-error_um / UM_PER_MM)),
        f"$AN_CEC_INPUT_AXIS[{number}]=({table.along or table.axis}1)",
        f"$AN_CEC_OUTPUT_AXIS[{number}]=({table.axis}1)",
        f"$AN_CEC_STEP[{number}]={step:z.6f}",
        f"$AN_CEC_MIN[{number}]={low:z.6f}",
        f"$AN_CEC_MAX[{number}]={low + last * step:z.6f}",
        f"$AN_CEC_DIRECTION[{number}]={direction}",
        f"$AN_CEC_MULT_BY_TABLE[{number}]=0",
        f"$AN_CEC_IS_MODULO[{number}]=0",
    ]


def _cec_notes(table: AxisTable) -> list[str]:
    first = _TABLES_OF_AN_AXIS * _AXES.index(table.axis)
    across = ", ".join(other.along for other in table.across)
    return [
        BY_MEMORY,
        f"tables {first} and {first + 1} are of the two directions of {table.axis}1: lost motion is in them, BACKLASH of the axis "
        "must be 0, and no other compensation of its position may be on",
        *([f"tables from {first + 2} on move {table.axis}1 with {across}"] if across else []),
        "an 828D has 8 tables: those of two axes; the names of the machine axes are ours",
    ]


CEC_FORM = AxisForm(_write, _cec_notes, _CEC_POINTS, across=True)
