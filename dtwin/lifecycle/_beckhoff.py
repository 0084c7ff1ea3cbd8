"""Leadscrew error compensation of the ISG kernel: TwinCAT CNC (TF5200), and controls of others on the same kernel.

Keys and units of 0.1 µm are of Beckhoff's public pages on P-COMP-00001 and 00017 to 00025; the number of entries must be below
1500 (P-COMP-00059). The sign is that of the formula in their examples, actual minus commanded: 19866.7 µm commanded and 19856.5 µm
reached is -102. Their list has that position with a minus, which the formula leaves out; with it the axis would move ahead of
its command by 18 µm of play, so that it is the list that is wrong.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from dtwin.errors import InputError
from dtwin.lifecycle._axis_tables import BY_MEMORY, AxisForm, AxisTable, require_apart
from dtwin.schema import Floats
from dtwin.units import UM_PER_MM

_PER_UM, _PER_MM = 10, 10_000
_ENTRIES = 1499
# Builds of before hold 16 bits.
_LARGEST = 32767
_SIGN = "Values are actual minus commanded, by the formula of Beckhoff's pages; their list could be read the other way: look at the sign first."


def _grid(low: float, high: float, count: int) -> Floats:
    """Return evenly spaced positions, each a whole number of 0.1 µm."""
    first, last = math.floor(low * _PER_MM), math.ceil(high * _PER_MM)
    return (first + math.ceil((last - first) / (count - 1)) * np.arange(count)) / _PER_MM


def _write(table: AxisTable, said: Sequence[str]) -> str:
    """Return the list of one axis, for both directions.

    Raises ``InputError`` when rows are less than 1 um apart or a value does not fit into 16 bits.
    """
    require_apart(table)
    pos, neg = (np.round(error * _PER_UM).astype(int) for error in (table.forward_um, table.reverse_um))
    largest = int(max(np.abs(pos).max(), np.abs(neg).max()))
    if largest > _LARGEST:
        raise InputError(
            "a value is larger than the control takes",
            code="export.step",
            got=f"{largest / _PER_UM:g} µm",
            allowed=f"{_LARGEST / _PER_UM:g} µm",
        )
    at = np.round(table.position_mm * _PER_MM).astype(int)
    keys = {
        "kopf.achs_nr": "XYZ".index(table.axis) + 1,
        "kopf.log_achs_name": f"{table.axis}_AXIS",
        "kw.ssfk.unit": 1,
        "kw.ssfk.interval": at[1] - at[0],
        "kw.ssfk.kw_startpos": at[0],
        "kw.ssfk.kw_nr_max": len(at),
        "kw.ssfk.bilateral": 1,
        "kw.ssfk.modulo": 0,
        **{f"kw.ssfk.table[{n}].pos": value for n, value in enumerate(pos)},
        **{f"kw.ssfk.table[{n}].neg": value for n, value in enumerate(neg)},
    }
    lines = [
        *(f"# {line}" for line in (*said, BY_MEMORY, _SIGN)),
        *(f"{key:<28} {value}" for key, value in keys.items()),
    ]
    return "\n".join(lines) + "\n"


def _notes(table: AxisTable) -> list[str]:
    return [
        BY_MEMORY,
        f"interval {UM_PER_MM * (table.position_mm[1] - table.position_mm[0]):z.1f} µm, values rounded to 0.1 µm",
        "lost motion is in the list: set the backlash of this axis to 0; lr_param.ssfk 1 switches it on",
    ]


FORM = AxisForm(_write, _notes, _ENTRIES, _grid)
