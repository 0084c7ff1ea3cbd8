"""Strokes of the axes of a machine, as its geometry states them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dtwin.errors import InputError
from dtwin.units import is_number


def stroke_mm(geometry: Mapping[str, Any], axis: str, where: str) -> tuple[float, float]:
    """Return the two ends of the stroke of an axis."""
    reach = geometry.get(f"stroke_{axis}_mm")
    two = isinstance(reach, list | tuple) and len(reach) == 2 and all(map(is_number, reach))
    if isinstance(reach, list | tuple) and two and reach[0] < reach[1]:
        return float(reach[0]), float(reach[1])
    setting = f"machine_geometry.stroke_{axis}_mm"
    length = float(reach) if is_number(reach) and reach > 0.0 else 800.0
    raise InputError(
        "the stroke of an axis is needed",
        code="volumetric.stroke",
        where=f"{where} {setting}",
        got="nothing" if reach is None else f"one number: {reach}" if is_number(reach) else str(reach)[:60],
        allowed=f"two positions in mm, ascending, as the control counts them, such as [0.0, {length:z.1f}] or [{-length / 2:z.1f}, {length / 2:z.1f}]",
        hint="state it in campaign.toml; of a campaign that is in the lake already, which a change of campaign.toml does not reach: "
        f"dtwin amend NAME --set '{setting}=[LOW, HIGH]' --because WHY",
    )
