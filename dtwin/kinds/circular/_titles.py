"""What the titles above a table of a circle tell of its run: direction, plane, radius and feed."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from dtwin.errors import InputError
from dtwin.kinds.circular._circle_ways import require_one_way, way_of_title, ways_above

_TOLD_ABOVE = (
    (
        "radius_mm",
        re.compile(
            r"(?:\bradius\b\W*(?:\[?mm\]?\W*|(?=\S+\s*mm))|\br\s*=\s*)(\d+(?:[.,]\d+)?)(?![\d.,]|\s*mm\s*/)", re.I
        ),
    ),
    ("feed_mm_min", re.compile(r"\b(?:feed ?rate|feed|vorschub)\b\W*(\d+(?:[.,]\d+)?)[\s;]*(m?m)\s*/\s*min", re.I)),
)
"""Conditions as titles above the heads tell them, a feed in mm/min or m/min."""
_PLANE = "plane|ebene|plan|piano|plano"
_PLANE_ABOVE = re.compile(
    rf"\b(?:{_PLANE})\b\W*(?:is\s+)?([xyz])\W?([xyz])\b|(?<!\w)([xyz])\W?([xyz])[\s-]*(?:{_PLANE})\b|\b(g1[789])\b",
    re.I,
)
_OF_CODE = {"G17": "XY", "G18": "ZX", "G19": "YZ"}
_SAME = 0.01


def require_as_titled(above: Sequence[Sequence[str]], stated: Mapping[str, Any], path: Path) -> None:
    """Refuse a radius, a feed or a plane that is not the one which the titles of the table tell."""
    titles = [" ".join(row) for row in above]

    def found(form: re.Pattern[str]) -> re.Match[str] | None:
        return next((match for title in titles if (match := form.search(title)) is not None), None)

    for name, form in _TOLD_ABOVE:
        read, told = found(form), stated.get(name)
        scale = 1000.0 if read is not None and read[form.groups].lower() == "m" else 1.0
        if read is not None and told and abs(scale * float(read[1].replace(",", ".")) - told) > _SAME * told:
            raise _titled(read[0], f"{name} {told:g}", path)
    plane, told = found(_PLANE_ABOVE), str(stated.get("plane", ""))
    if plane is not None and told:
        named = "".join(filter(None, plane.groups())).upper()
        if set(_OF_CODE.get(named, named)) != set(told):
            raise _titled(plane[0], f"plane {told}", path)


def told_by_titles(above: Sequence[Sequence[str]], stated: Mapping[str, Any], path: Path) -> Mapping[str, Any]:
    """Return the direction that the titles above a table tell, where none is stated; refuse another condition than the stated one."""
    require_as_titled(above, stated, path)
    ways, told = ways_above(above), stated.get("direction")
    if told is None:
        require_one_way(above, path)
        return {"direction": ways.pop()} if ways else {}
    if ways and told not in ways:
        raise _titled("; ".join(" ".join(row) for row in above if way_of_title(row)), f"direction {told}", path)
    return {}


def _titled(got: str, told: str, path: Path) -> InputError:
    return InputError(
        "the titles of the table tell another condition",
        code="circle_table.form",
        where=str(path),
        got=got[:120],
        allowed=f"{told}, as it is told",
        hint="docs/how-to/ingest-your-own.md, tables of circles",
    )
