"""Angles of a rotary axis: targets in degrees, deviations in seconds of arc."""

from __future__ import annotations

from dtwin.errors import InputError
from dtwin.positioning.table_heads import MOVES
from dtwin.positioning.ways import Scale
from dtwin.units import ANGLES_DEG

ANGLES = Scale(
    kind="rotary",
    position="angle_deg",
    error="error_arcsec",
    read="read_deg",
    unit="°",
    fine="″",
    figure="arcsec",
    per=3600.0,
    units=ANGLES_DEG,
    largest=3600.0,
    longest=36_000.0,
    allowed="°, mdeg, arcmin, arcsec, ″, rad, mrad, µrad, gon, mgon; grad is a degree in German and 1/400 of a turn elsewhere",
    elsewhere="a table of lengths is one of a linear axis: --kind linear --axis X",
    turn=360.0,
)


def require_turning(axis: str, where: str) -> None:
    """Refuse an axis whose name is one of those that move along."""
    if MOVES.fullmatch(axis):
        raise InputError(
            "an axis of this name moves along, and a rotary test is of an axis that turns",
            code="rotary.axis",
            where=where,
            got=f"axis {axis}",
            allowed="an axis that turns, such as A, B or C",
            hint="--axis C; where the file has a table of this axis in lengths, too, --kind linear with --axis reads that; pitch and yaw of an axis that moves along are not read",
        )
