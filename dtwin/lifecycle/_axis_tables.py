"""Tables of one axis over its position, what a control wants of one, LinuxCNC's compensation file and CSV."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dtwin.errors import InputError
from dtwin.physics.problem import Term
from dtwin.physics.twin import Twin
from dtwin.schema import Floats
from dtwin.train.twin_axes import AXES, axis_table_um, own_axis_only
from dtwin.units import UM_PER_MM

MOST_TRIPLETS = 256
NOT_LOADED = "Read back by dtwin's own interpreter of this form; never loaded into a control."
BY_MEMORY = (
    "The form is written from memory and public manuals: try a few rows with an indicator before the whole table."
)
TOLERANCE_UM = 0.05
_CHECKED = 4001
_LEAST_MM = 0.001


@dataclass(frozen=True)
class AxisTable:
    """Error of one axis over its position.

    ``axis``: X, Y or Z.
    ``position_mm``, (n,): nominal positions in the coordinates of the machine, ascending.
    ``forward_um``, ``reverse_um``, (n,): actual minus nominal, by direction of motion; lost motion is in the
    difference.
    ``interpolation_um``: largest error of straight lines between the rows.
    ``left_share``: RMS that straight lines between the rows leave of the error, over that of the error, both from their means.
    ``along``: axis of the positions, where it is another one; empty without.
    ``across``: tables of this axis over the positions of the others.
    """

    axis: str
    position_mm: Floats
    forward_um: Floats
    reverse_um: Floats
    interpolation_um: float
    along: str = ""
    left_share: float = 0.0
    across: tuple[AxisTable, ...] = ()


_Grid = Callable[[float, float, int], Floats]
"""Positions between two ends, mm, ascending; no more than so many."""


@dataclass(frozen=True)
class AxisForm:
    """How a control takes the table of one axis.

    ``write``: from the table and the comments of its head.
    ``notes``: what the user must know besides.
    ``most``: rows that the control holds.
    ``grid``: where its rows may lie; evenly without.
    ``across``: whether it also holds what depends on the position of one other axis.
    ``held_um``: how far a value may be from the error, where the control may hold that of a row up to the next;
    infinite where it draws straight lines.
    """

    write: Callable[[AxisTable, Sequence[str]], str]
    notes: Callable[[AxisTable], list[str]]
    most: int = MOST_TRIPLETS
    grid: _Grid = np.linspace
    across: bool = False
    held_um: float = np.inf


def axis_table(
    twin: Twin,
    axis: str,
    travel_mm: tuple[float, float],
    *,
    origin_mm: float,
    points: int | None,
    speed_mm_s: float,
    most: int = MOST_TRIPLETS,
    grid: _Grid = np.linspace,
    along: str = "",
    held_um: float = np.inf,
) -> AxisTable:
    """Tabulate one axis with as few rows as the tolerance allows.

    ``twin``: reduced to effects of this axis alone.
    ``axis``: X, Y or Z.
    ``travel_mm``: first and last nominal position, in the coordinates of the machine.
    ``origin_mm``: position of the centre of the measured circles in those coordinates.
    ``points``: rows; without, as many as straight lines within 0.05 um need.
    ``speed_mm_s``: usual speed; only its sign counts.
    ``most``: rows that the control holds.
    ``grid``: where its rows may lie; beyond the travel the error of its end is kept.
    ``along``: axis of the positions, where it is another one.
    ``held_um``: of the form.
    """

    def errors_um(at: Floats) -> tuple[Floats, Floats]:
        return axis_table_um(twin, axis, at - origin_mm, speed_mm_s, along or axis)

    return tabulated(axis, errors_um, travel_mm, points=points, most=most, grid=grid, along=along, held_um=held_um)


def tabulated(
    axis: str,
    errors_um: Callable[[Floats], tuple[Floats, Floats]],
    travel_mm: tuple[float, float],
    *,
    points: int | None,
    most: int = MOST_TRIPLETS,
    grid: _Grid = np.linspace,
    along: str = "",
    held_um: float = np.inf,
) -> AxisTable:
    """Tabulate errors of one axis with as few rows as the tolerance allows; arguments as of ``axis_table``.

    ``errors_um``: of positions on the machine, going up and going down.
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
    truth = errors_um(dense)
    doubled = (2, 3, 5, 9, 17, 33, 65, 129, 257, 513)
    counts = [points] if points is not None else [*(n for n in doubled if n < most), most]
    for count in counts:
        at = grid(low, high, count)
        forward, reverse = errors_um(np.clip(at, low, high))
        ways = list(zip((forward, reverse), truth, strict=True))
        off = max(float(np.abs(np.interp(dense, at, rows) - exact).max()) for rows, exact in ways)
        row = np.clip(np.searchsorted(at, dense, side="right") - 1, 0, len(at) - 2)
        held = max(float(np.abs(rows[row + end] - exact).max()) for rows, exact in ways for end in (0, 1))
        if off <= TOLERANCE_UM and held <= held_um:
            break
    left = np.array([np.interp(dense, at, rows) - exact for rows, exact in ways])
    before_um = float(np.std(truth))
    return AxisTable(
        axis, at, forward, reverse, off, along, float(np.std(left)) / before_um if before_um > 0.0 else 0.0
    )


def _of(twin: Twin, labels: Collection[str]) -> tuple[Term, ...]:
    return tuple(t for t in twin.terms if t.label in labels)


def with_across(
    table: AxisTable, twin: Twin, refused: Mapping[str, str], origin_mm: Sequence[float], form: AxisForm
) -> tuple[AxisTable, dict[str, str]]:
    """Return the table with what depends on the position of one other axis alone, and what is left out then.

    ``refused``: from ``own_axis_only``.
    ``origin_mm``, (3,): centre of the measured circles in the coordinates of the machine.
    """
    left, tables = dict(refused), []
    twin = replace(twin, terms=_of(twin, refused))
    speed, reach = twin.box.feed_mm_min[0] / 60.0, twin.box.radius_mm[1]
    for other in (a for a in AXES if a != table.axis and any(a in plane for plane in twin.box.planes)):
        centre = origin_mm[AXES.index(other)]
        wrong = own_axis_only(twin.terms, twin, table.axis, (-reach, reach), speed, other)
        kept = replace(twin, terms=_of(twin, [label for label in left if label not in wrong]))
        made = axis_table(
            kept,
            table.axis,
            (centre - reach, centre + reach),
            origin_mm=centre,
            points=None,
            speed_mm_s=speed,
            most=form.most,
            along=other,
        )
        if np.abs(made.forward_um).max() > 0.0:
            tables.append(made)
            left = {label: why for label, why in left.items() if label in wrong or not _acts(kept, label, made)}
    return replace(table, across=tuple(tables)), left


def _acts(twin: Twin, label: str, table: AxisTable) -> bool:
    """Tell whether an effect does anything to an axis over the positions of another one."""
    only = replace(twin, terms=_of(twin, [label]))
    at = np.linspace(-twin.box.radius_mm[1], twin.box.radius_mm[1], 9)
    forward, _ = axis_table_um(only, table.axis, at, twin.box.feed_mm_min[0] / 60.0, table.along)
    return bool(np.abs(forward).max() > 0.0)


def compensation_file(table: AxisTable, said: Sequence[str] = ()) -> str:
    """Return LinuxCNC's COMP_FILE of type 1: nominal, forward trim, reverse trim in mm.

    A trim is added to the command of the joint; backlash is in the difference of the two, so that
    ``BACKLASH`` of the joint must be 0. LinuxCNC stops reading at the first line that is no row: what is ``said`` stands
    below the rows.

    Raises ``InputError`` when rows would be less than 1 um apart.
    """
    require_apart(table)
    rows = zip(table.position_mm, table.forward_um, table.reverse_um, strict=True)
    lines = [f"{p:z.6f} {0.0 - f / UM_PER_MM:z.6f} {0.0 - r / UM_PER_MM:z.6f}" for p, f, r in rows]
    return "\n".join([*lines, *(f"# {line}" for line in said)]) + "\n"


def _linuxcnc(table: AxisTable, said: Sequence[str]) -> str:
    form = f"axis {table.axis}, COMP_FILE_TYPE = 1: position, forward and reverse trim in mm, for LINEAR_UNITS = mm"
    return compensation_file(table, [*(line for line in said if line != NOT_LOADED), form])


def _comp_notes(table: AxisTable) -> list[str]:
    return [
        "COMP_FILE_TYPE = 1; set BACKLASH of this joint to 0: it is in the table",
        "positions and trims are mm: for a machine whose LINEAR_UNITS is mm",
        "LinuxCNC reads it at its start; tried in simulation only: dtwin linuxcnc measure",
    ]


LINUXCNC = AxisForm(_linuxcnc, _comp_notes)


def require_apart(table: AxisTable) -> None:
    """Refuse rows that are closer together than a control takes."""
    step = float(np.diff(table.position_mm).min())
    if step < _LEAST_MM:
        raise InputError(
            "the rows of the table are too close together",
            code="export.step",
            got=f"{step:g} mm",
            allowed=f"{_LEAST_MM:g} mm or more",
            hint="--travel LOW,HIGH, --points N",
        )


def lost_motion_um(table: AxisTable) -> tuple[float, float]:
    """Return the mean of reverse minus forward, and how far one row is from it, both in um."""
    difference = table.reverse_um - table.forward_um
    mean = float(difference.mean())
    return mean, float(np.abs(difference - mean).max())


def lost_motion_notes(table: AxisTable, setting: str) -> Iterator[str]:
    """Yield that one curve serves both directions, and what of the lost motion its setting does not hold."""
    mean, uneven = lost_motion_um(table)
    yield f"one curve for both directions: set {setting} to {mean / UM_PER_MM:z.6f} mm"
    if uneven > TOLERANCE_UM:
        yield f"lost motion changes along the axis: by up to {uneven:z.2f} µm it is not what {setting.split()[0]} holds"


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
