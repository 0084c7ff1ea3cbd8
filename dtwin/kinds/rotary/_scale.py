"""Angles of a rotary axis: targets in degrees, deviations in seconds of arc."""

from __future__ import annotations

from dtwin.positioning.scale import Scale
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
