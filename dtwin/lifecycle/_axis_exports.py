"""Tables of single axes: which form takes them how, and what of a twin is in them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from dtwin.errors import InputError
from dtwin.lifecycle import _beckhoff, _fanuc, _haas, _heidenhain, _siemens
from dtwin.lifecycle._axis_tables import (
    LINUXCNC,
    MOST_TRIPLETS,
    NOT_LOADED,
    TOLERANCE_UM,
    AxisForm,
    AxisTable,
    axis_table,
    csv_table,
    tabulated,
    with_across,
)
from dtwin.lifecycle._export_records import Export, Request, Source, whose
from dtwin.physics.twin import Twin
from dtwin.train.twin_axes import AXES, AxisErrors, own_axis_only

ONE_AXIS: Mapping[str, AxisForm] = {
    "comp": LINUXCNC,
    "siemens": _siemens.FORM,
    "siemens-cec": _siemens.CEC_FORM,
    "heidenhain": _heidenhain.FORM,
    "fanuc": _fanuc.FORM,
    "fanuc30i": _fanuc.FORM_30I,
    "haas": _haas.FORM,
    "beckhoff": _beckhoff.FORM,
}
# Ends that were rounded are still within what was measured.
_REACH_MM = 1e-6
_MOST_LEFT = 0.99


def tables_of(source: Source, twin: Twin, request: Request) -> Export:
    """Write tables of the axes of a twin of circles."""
    axes = _axes(request, [a for a in AXES if any(a in plane for plane in twin.box.planes)])
    form = ONE_AXIS.get(request.form)
    reach = twin.box.radius_mm[1]
    speed = twin.box.feed_mm_min[0] / 60.0
    tables: list[AxisTable] = []
    left_out: dict[str, str] = {}
    measured = {}
    for axis in axes:
        number = AXES.index(axis)
        origin = request.origin_mm[number]
        measured[axis] = (origin - reach, origin + reach)
        travel = request.travel_mm or measured[axis]
        relative = (travel[0] - origin, travel[1] - origin)
        refused = own_axis_only(twin.terms, twin, axis, relative, speed)
        kept = replace(twin, terms=tuple(t for t in twin.terms if t.label not in refused))
        table = axis_table(kept, axis, travel, origin_mm=origin, speed_mm_s=speed, **_rows(request))
        if form is not None and form.across:
            table, refused = with_across(table, twin, refused, request.origin_mm, form)
        left_out |= {f"{label} on {axis}": reason for label, reason in refused.items()}
        tables.append(table)
    beyond = _beyond(measured, request, "the table is what the twin's formulas go on to")
    return _written(source, request, tables, left_out, beyond)


def positioning_table(source: Source, errors: AxisErrors, request: Request) -> Export:
    """Write the table of an axis whose equation knows its position and direction."""
    (axis,) = _axes(request, [errors.axis])
    origin = request.origin_mm[AXES.index(axis)]
    low, high = errors.measured_mm
    measured = (origin + low, origin + high)
    travel = request.travel_mm or measured
    beyond = _beyond({axis: measured}, request, "the table keeps the values of its ends")
    table = tabulated(axis, lambda at: errors.um(at - origin), travel, **_rows(request))
    return _written(source, request, [table], {}, beyond)


def _axes(request: Request, measured: Sequence[str]) -> Sequence[str]:
    if request.form not in ONE_AXIS:
        return measured
    if request.axis not in measured:
        raise InputError(
            "a compensation file is for one axis",
            code="export.axis",
            got=request.axis or "none",
            allowed=", ".join(measured),
            hint=f"--axis {measured[0]}",
        )
    return [request.axis]


def _rows(request: Request) -> dict[str, Any]:
    form = ONE_AXIS.get(request.form)
    most, grid, held_um = (MOST_TRIPLETS, np.linspace, np.inf) if form is None else (form.most, form.grid, form.held_um)
    return {"points": request.points, "most": most, "grid": grid, "held_um": held_um}


def _written(
    source: Source, request: Request, tables: Sequence[AxisTable], left_out: Mapping[str, str], beyond: Sequence[str]
) -> Export:
    form = ONE_AXIS.get(request.form)
    most = MOST_TRIPLETS if form is None else form.most
    if form is None:
        text, said = csv_table(list(tables)), []
    else:
        _require_something(source.bundle.name, tables[0], left_out)
        text = form.write(tables[0], [*whose(source.bundle, source.version, source.state), NOT_LOADED, *beyond])
        said = [*([] if form is LINUXCNC else [NOT_LOADED]), *form.notes(tables[0])]
    return Export(text, _table_figures(tables), left_out, (*_table_notes(request, tables, most), *beyond, *said))


def _beyond(measured: Mapping[str, tuple[float, float]], request: Request, what: str) -> list[str]:
    """Return what to say of positions that were not measured; raises InputError where none of the travel was."""
    if request.travel_mm is None:
        return []
    said = []
    for axis, (low, high) in measured.items():
        if request.travel_mm[1] <= low or request.travel_mm[0] >= high:
            raise InputError(
                "nothing of this travel was measured",
                code="export.travel",
                where=f"axis {axis}",
                got="{:g} to {:g} mm".format(*request.travel_mm),
                allowed=f"{low:g} to {high:g} mm, in part at least",
                hint="--origin X,Y,Z says where the tests lay on the machine",
            )
        if request.travel_mm[0] < low - _REACH_MM or request.travel_mm[1] > high + _REACH_MM:
            said.append(f"axis {axis}: measured from {low:g} to {high:g} mm; beyond, {what}")
    return said


def _require_something(name: str, table: AxisTable, left_out: Mapping[str, str]) -> None:
    """Refuse a table that corrects nothing: whoever loads it believes that something is corrected."""
    if table.left_share > _MOST_LEFT:
        raise InputError(
            "the rows are too far apart: the table takes nothing of the error away",
            code="export.points",
            where=f"{name}, axis {table.axis}",
            got=f"{len(table.position_mm)} rows leave {table.left_share:.0%} of the error (RMS)",
            allowed=f"{_MOST_LEFT:.0%} at most",
            hint="--travel with less, --points with more, or dtwin serve",
        )
    if table.across or max(np.abs(table.forward_um).max(), np.abs(table.reverse_um).max()) > 0.0:
        return
    raise InputError(
        "the twin has nothing that a table of this axis holds",
        code="export.effects",
        where=f"{name}, axis {table.axis}",
        got="; ".join(f"{label}: {why}" for label, why in left_out.items()) or f"no error of {table.axis}",
        hint="another --axis; --as gcode holds what depends on several axes, on the feed or on the acceleration",
    )


def _table_figures(tables: Sequence[AxisTable]) -> dict[str, Any]:
    return {
        "axes": {
            t.axis: {
                "rows": len(t.position_mm),
                "travel_mm": [float(t.position_mm[0]), float(t.position_mm[-1])],
                "interpolation_error_um": t.interpolation_um,
                "largest_um": float(max(np.abs(t.forward_um).max(), np.abs(t.reverse_um).max())),
            }
            for t in tables
        }
    }


def _table_notes(request: Request, tables: Sequence[AxisTable], most: int) -> list[str]:
    return [
        f"axis {t.axis}: straight lines between the rows are {t.interpolation_um:z.2f} µm off and leave {t.left_share:.0%} of the "
        f"error (RMS); a table of {most} rows is not enough for {TOLERANCE_UM:g} µm"
        for t in tables
        if t.interpolation_um > TOLERANCE_UM and request.points is None
    ]
