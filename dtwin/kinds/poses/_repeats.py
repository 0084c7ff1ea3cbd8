"""Measured places without commanded ones, read again and again: how poses repeat, and no accuracy."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from dtwin.acquire.foreign_columns import below_heads, columns_of
from dtwin.acquire.xmlsafe import number_or_none
from dtwin.errors import InputError
from dtwin.schema import Floats
from dtwin.units import UM_PER_MM

_MOST_TITLES = 12
COUNTS = re.compile(
    r"(repeat|repetition|cycle|run|trial|approach|wiederholung|zyklus|messung|anfahrt|lauf)([\s_.]*(no|nr|number|nummer|#))?\.?",
    re.I,
)
PLACES = re.compile(
    r"(pose|point|punkt|position|target|reflector|reflektor|smr|ziel)([\s_.]*(no|nr|number|nummer|id|name|#))?\.?", re.I
)
_AXIS = re.compile(r"(?:measured_|meas_|actual_|ist_|position_|pos_)?([xyz])_(mm|um)")
_FEWEST = 3
_SHOWN = 4


def repeated_places(rows: Sequence[Sequence[str]]) -> Mapping[str, Floats]:
    """Return the readings (n, 3) in mm of each place of a table of repeats and measured X, Y and Z alone; else nothing."""
    for begin, row in enumerate(rows[:_MOST_TITLES]):
        heads = [cell.strip() for cell in row]
        if not any(map(COUNTS.fullmatch, heads)):
            continue
        units, body = below_heads([list(line) for line in rows], begin)
        found = [_AXIS.fullmatch(column.name) for column in columns_of(heads, units, {})]
        axes = {match[1]: n for n, match in enumerate(found) if match}
        others = [h for h, match in zip(heads, found, strict=True) if h and not match]
        known = all(COUNTS.fullmatch(h) or PLACES.fullmatch(h) for h in others)
        if len(axes) != 3 or sum(map(bool, found)) != 3 or not known:
            return {}
        scale = [1.0 / UM_PER_MM if found[axes[a]][2] == "um" else 1.0 for a in "xyz"]  # type: ignore[index]
        factors = [columns_of(heads, units, {})[axes[a]].factor for a in "xyz"]
        place = next((n for n, h in enumerate(heads) if PLACES.fullmatch(h)), None)
        told: dict[str, list[list[float]]] = {}
        for line in body:
            values = [number_or_none(line[axes[a]]) if axes[a] < len(line) else None for a in "xyz"]
            name = line[place].strip() if place is not None and place < len(line) else ""
            if None not in values:
                told.setdefault(name, []).append([v * s * f for v, s, f in zip(values, scale, factors, strict=True)])  # type: ignore[operator]
        return {name: np.array(points) for name, points in told.items() if len(points) >= _FEWEST}
    return {}


def no_commanded(path: Path, places: Mapping[str, Floats]) -> InputError:
    """Return the refusal of places that nobody says where they should be, with the repeatability of ISO 9283."""
    told = []
    for name, points in places.items():
        off = np.linalg.norm(points - points.mean(axis=0), axis=1)
        rp = float(off.mean() + 3.0 * off.std(ddof=1))
        told.append((rp, f"RP {rp:z.3g} mm of {len(points)} readings" + f" of {name}" * bool(name)))
    worst = [text for _, text in sorted(told, reverse=True)[:_SHOWN]]
    return InputError(
        "the table tells where poses were measured, not where they were commanded: how they repeat, and no accuracy",
        code="poses.commanded",
        where=str(path),
        got="; ".join(worst),
        allowed="commanded places beside: Target X [mm], Target Y [mm], Target Z [mm]",
        hint="the repeatability of ISO 9283 is what is got, the largest first; the standard asks for thirty readings",
    )
