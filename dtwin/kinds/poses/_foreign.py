"""Heads of poses as cameras and ROS write them: heads in several rows become one, and what each would be named here."""

from __future__ import annotations

import re
from collections.abc import Sequence

_MOST_TITLES = 12
_UNITS = {"meters": "m", "millimeters": "mm", "m": "m", "mm": "mm"}
_ROS = re.compile(r"(?:.*[./ ])?(position|translation|orientation|rotation)[./]([xyzw])$", re.I)
_GERMAN = re.compile(
    r"(?:(?P<what>soll|ist)[ _-]*(?:pos(?:ition)?\.?|wert)?[ _-]*(?P<axis>[xyz])|(?P<axis2>[xyz])[ _-]*(?P<what2>soll|ist)(?:pos(?:ition)?\.?|wert)?)"
    r"(?:[ _]*(?:in |[\[(/_])? *(?P<unit>mm|m|µm|μm|um)[\])]?)?",
    re.I,
)
_VICON = re.compile(r".* T?([XYZ])$")


def joined(rows: Sequence[Sequence[str]]) -> tuple[list[str], list[Sequence[str]], str] | None:
    """Return heads, rows below them and the unit of lengths of an export of OptiTrack Motive or Vicon; None of another file.

    Above a row that begins with ``Frame`` stand names, and, of OptiTrack, what a column is: ``tool Position.X``, ``tool TX``.
    """
    begin = next((n for n, row in enumerate(rows[:_MOST_TITLES]) if row and row[0].strip().lower() == "frame"), 0)
    above = [row for row in rows[:begin] if len(row) > 2 and not row[0].strip()]
    if not above or len(rows) < begin + 2:
        return None
    named = next((row for row in above if row[1].strip().lower() == "name"), above[min(1, len(above) - 1)])
    lines = [named] if named is above[-1] else [named, above[-1]]
    last, heads = "", []
    for n, head in enumerate(rows[begin]):
        told = [line[n].strip() if n < len(line) else "" for line in lines]
        # Of Vicon a name stands above the first of its columns.
        last = told[0] or last
        axis = ".".join(part for part in (*told[1:], head.strip()) if part)
        heads.append(f"{last} {axis}" if last and n > 1 else head.strip())
    below = [cell.strip().lower() for cell in rows[begin + 1]]
    units = below if not below[0] else [cell.strip().lower() for cell in rows[0]]
    body = list(rows[begin + (2 if not below[0] else 1) :])
    return heads, body, next((_UNITS[unit] for unit in units if unit in _UNITS), "m")


def of_ros(heads: Sequence[str]) -> bool:
    """Return whether heads are those of a pose as ROS flattens it: ``pose.position.x``."""
    return any(_ROS.match(head.strip()) for head in heads)


def of_german(head: str) -> str:
    """Return the house's name of ``Soll X [mm]`` or ``x_ist``, in millimetres where no unit is told; other heads as they are."""
    found = _GERMAN.fullmatch(head)
    if found is None:
        return head
    what, axis = (found["what"] or found["what2"]).lower(), (found["axis"] or found["axis2"]).lower()
    unit = (found["unit"] or "mm").lower().replace("µ", "u").replace("μ", "u")
    return f"{'target' if what == 'soll' else 'measured'}_{axis}_{unit}"


def lines_for(heads: Sequence[str], unit: str) -> list[str]:
    """Return lines of ``[campaign.instrument.columns]`` that would name foreign heads as measured ones; empty when none is known."""
    out = []
    for head in heads:
        ros, vicon = _ROS.match(head), _VICON.match(head)
        if ros is not None and ros[1].lower() in ("position", "translation") and ros[2].lower() != "w":
            out.append(f'"{head}" = "measured_{ros[2].lower()}_{unit}"')
        elif ros is not None:
            out.append(f'"{head}" = "measured_q{ros[2].lower()}"')
        elif vicon is not None:
            out.append(f'"{head}" = "measured_{vicon[1].lower()}_{unit}"')
    return out
