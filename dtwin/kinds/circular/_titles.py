"""What the titles above a table of a circle tell of its run: direction, plane, radius and feed."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dtwin.acquire.foreign_columns import Column, converted, header_row
from dtwin.acquire.spreadsheet import first_text
from dtwin.acquire.table_dialect import remarks_of, rows_of
from dtwin.errors import InputError
from dtwin.kinds.circular._circle_ways import (
    direction_column,
    require_one_way,
    require_ways,
    way_of,
    way_of_title,
    ways_above,
)
from dtwin.kinds.circular._one_circle import require_one_circle

_NUMBER = r"(\d+(?:[.,]\d+)?)(?![\d.,])"
_TOLD_ABOVE = (
    (
        "radius_mm",
        re.compile(
            rf"(?:(?:(?<!tool )(?<!ball )(?<!probe )(?<!stylus )(?<!corner )(?<![^\W_])(?:nenn|soll|kreis|bahn)?radius|\b(?:rayon|raggio|radio)\b)(?:\W*[\[(]?\bmm\b[\])]?\W*|\W*(?=\S+\s*mm))|\br\s*=\s*|"
            rf"\b(?:ball ?bar|bar|kugelstange\w*|stange\w*)[ -]*(?:length|länge|laenge)\W*(?=\S+\s*mm)|\blänge der (?:kugel)?stange\W*(?=\S+\s*mm)){_NUMBER}(?!\s*mm\s*/|\s*[µμu]m\b)",
            re.I,
        ),
    ),
    (
        "feed_mm_min",
        re.compile(
            rf"\b(?:feed ?rate|feed|vorschub|avance|avanzamento)\b\W*(?:f\b\W*)?(?:mm/min\W*)?{_NUMBER}[\s;]*(?:(m?m)\s*/\s*min|$)",
            re.I,
        ),
    ),
)
"""Conditions as titles above the heads tell them, a feed in mm/min or m/min."""
_PLANE = "plane|ebene|plan|piano|plano"
_PLANE_ABOVE = re.compile(
    rf"\b(?:{_PLANE})\b\W*(?:is\s+)?([xyz])\W?([xyz])\b|(?<!\w)([xyz])\W?([xyz])[\s-]*(?:{_PLANE})\b|\b(g1[789])\b",
    re.I,
)
_PLANE_IN_HEAD = re.compile(r"(?<![^\W_])(xy|xz|yz|zx|yx|zy)(?![^\W_])", re.I)
_DIAMETER_ABOVE = re.compile(
    rf"(?:\bcircle |\bpath |\bnominal |^\W*|\bkreis-?|\bnenn|\bsoll)(?:diameter|durchmesser)\W*{_NUMBER}\s*mm\b", re.I
)
_ZERO = re.compile(
    r"(?:\b0\s*(?:°|deg\b|grad\b)?|\b(?:null|zero|angles?|winkel))\s*(?:=|is\b|ist\b|at\b|bei\b|auf\b|from\b|von\b|ab\b)\s*([+\-\u2212]?)\s*([xyz])\b",
    re.I,
)
"""Where a title says that angles begin."""
_WITH_CLOCK = re.compile(
    r"\b(?:angles?|winkel)\b[^,;]{0,60}\b(?:(?:counted|gez[äa]hlt|positiv\w*|increas\w*)\b(?![^,;]{0,60}(?:counter|anti|gegen|against))[^,;]{0,60}(?:clock|uhrzeigersinn)"
    r"|(?<!counter[- ])(?<!anti[- ])clockwise from\b)",
    re.I,
)
"""A title of angles that run with the clock."""
_OF_CODE = {"G17": "XY", "G18": "ZX", "G19": "YZ"}
_SAME = 0.01
_SLOWEST_MM_MIN = 50.0
_MOST_BYTES = 64 * 1024**2


def _value(name: str, number: str, unit: str) -> float:
    """Return a condition in mm or mm/min; of ``1.000 mm/min`` the mark parts groups of digits, for no circle is so slow."""
    value = float(number.replace(",", "."))
    grouped = name == "feed_mm_min" and re.fullmatch(r"\d{1,2}[.,]\d{3}", number) and value < _SLOWEST_MM_MIN
    return value * (1000.0 if unit.lower() == "m" or grouped else 1.0)


def _has_unit(told: re.Match[str], rest: str) -> bool:
    """Return whether a condition in a title, with what follows it there, has its unit."""
    return re.search(r"mm\b|m\s*/\s*min", told[0] + rest.lstrip()[:2], re.I) is not None


def told_above(path: Path) -> Mapping[str, Any]:
    """Return the conditions that the titles and remarks above a table tell, once and with their units."""
    try:
        text = first_text(path, _MOST_BYTES)
        rows = rows_of(text)
        titles = [" ".join(row) for row in [*remarks_of(text), *rows[: header_row(rows, path)]]]
    except InputError:
        return {}
    told: dict[str, Any] = {}
    for name, form in _TOLD_ABOVE:
        # A radius without a unit may be one of a tool, or a result.
        matches = [(m, title[m.end() :]) for title in titles for m in form.finditer(title)]
        read = {
            (m[1], "mm" if name == "radius_mm" else m[form.groups] or "mm") for m, rest in matches if _has_unit(m, rest)
        }
        if len(read) == 1:
            (number, unit), *_ = read
            told[name] = _value(name, number, unit)
    planes = {"".join(filter(None, m.groups())).upper() for title in titles for m in _PLANE_ABOVE.finditer(title)}
    named = planes.pop() if len(planes) == 1 else ""
    plane = _OF_CODE.get(named, named)
    return told | ({"plane": plane} if plane in _OF_CODE.values() else {})


def require_as_titled(above: Sequence[Sequence[str]], stated: Mapping[str, Any], path: Path) -> None:
    """Refuse a radius, a feed or a plane that is not the one which the titles of the table tell."""
    titles = [" ".join(row) for row in above]

    def found(form: re.Pattern[str]) -> re.Match[str] | None:
        return next((match for title in titles if (match := form.search(title)) is not None), None)

    for name, form in _TOLD_ABOVE:
        read, told = found(form), stated.get(name)
        if read is not None and told and abs(_value(name, read[1], read[form.groups] or "") - told) > _SAME * told:
            raise _titled(read[0], f"{name} {told:g}", path)
    plane, told = found(_PLANE_ABOVE), str(stated.get("plane", ""))
    if plane is not None and told:
        named = "".join(filter(None, plane.groups())).upper()
        if set(_OF_CODE.get(named, named)) != set(told):
            raise _titled(plane[0], f"plane {told}", path)
    named_planes = [match[0] for match in _PLANE_IN_HEAD.finditer(" ".join(titles))] if told else []
    if named_planes and all(set(name.upper()) != set(told) for name in named_planes):
        raise _titled(named_planes[0], f"plane {told}", path)
    diameter, radius = found(_DIAMETER_ABOVE), stated.get("radius_mm")
    if diameter is not None and radius and abs(_value("", diameter[1], "") / 2.0 - radius) > _SAME * radius:
        raise _titled(diameter[0], f"radius_mm {radius:g}", path)
    zero, turned = found(_ZERO), found(_WITH_CLOCK)
    if zero is not None and told and (zero[1] not in ("", "+") or zero[2].upper() != told[0]):
        raise _titled(zero[0], f"angles from +{told[0]} towards +{told[1]}", path)
    if turned is not None:
        raise _titled(turned[0], "angles against the clock, from the plane's first axis towards its second", path)


def told_by_table(
    above: Sequence[Sequence[str]],
    columns: Sequence[Column],
    body: Sequence[Sequence[str]],
    stated: Mapping[str, Any],
    path: Path,
) -> Mapping[str, Any]:
    """Return the direction that the titles above a table, or a column, tell, where none is stated; refuse another condition than the stated one, and rows of several circles."""
    require_as_titled(above, stated, path)
    ways, told = ways_above(above), stated.get("direction")
    if told is None:
        require_one_way(above, path)
    said = "; ".join(" ".join(row) for row in above if way_of_title(row))
    if (column := direction_column(columns, body)) is not None:
        require_ways(columns, body, path)
        cells = {row[column].strip() for row in body if column < len(row)} - {""}
        ways, said = {way for cell in cells if (way := way_of(cell.lower()))}, ", ".join(sorted(cells))
    if (told is None and len(ways) > 1) or (told is not None and ways and told not in ways):
        raise _titled(said, f"direction {told}" if told else "one direction", path)
    angle = next((i for i, c in enumerate(columns) if c.name == "angle_deg"), None)
    if angle is not None:
        values = np.array(
            [
                float(row[0] or "nan")
                for row in converted([columns[angle]], [row[angle : angle + 1] for row in body])[1:]
            ]
        )
        require_one_circle(columns, body, values, [None] * len(body), (), path)
    return {"direction": told or ways.pop()} if ways else {}


def _titled(got: str, told: str, path: Path) -> InputError:
    return InputError(
        "the titles of the table tell another condition",
        code="circle_table.form",
        where=str(path),
        got=got[:120],
        allowed=f"{told}, as it is told",
        hint="docs/how-to/ingest-your-own.md, tables of circles",
    )
