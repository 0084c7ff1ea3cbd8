"""Heads of poses as cameras and ROS write them: heads in several rows become one, and what each would be named here."""

from __future__ import annotations

import re
from collections.abc import Sequence

from dtwin.acquire.foreign_columns import in_english
from dtwin.units import LENGTHS_MM

_MOST_TITLES = 12
_UNITS = {"meters": "m", "millimeters": "mm", "m": "m", "mm": "mm"}
_ROS = re.compile(r"(?:.*[./ ])?(position|translation|orientation|rotation)[./]([xyzw])$", re.I)
_WORDS = {
    **dict.fromkeys(("soll", "target", "nominal", "command", "commanded", "cmd"), "target"),
    **dict.fromkeys(("error", "deviation", "fehler", "abweichung"), "error"),
    **dict.fromkeys(("ist", "measured", "meas", "actual", "act", "attained"), "measured"),
}
_WORD = "|".join(sorted(_WORDS, key=len, reverse=True))
NO_UNIT = "without_unit"
"""In the place of the unit in the name of a column of errors that tells none."""
_LENGTH = "|".join(sorted(LENGTHS_MM, key=len, reverse=True))
_PLACE = r"(?:pos(?:ition)?\.?|wert)?"
_TOLD = re.compile(
    rf"(?:(?P<what>{_WORD})[ _-]*{_PLACE}[ _-]*(?P<axis>[xyz])|(?P<axis2>[xyz])[ _-]*(?P<what2>{_WORD})[ _-]*{_PLACE})"
    rf"(?:[ _]*(?:in |[\[(/_])? *(?P<unit>{_LENGTH})[\])]?)?",
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


def of_words(head: str, below: str = "") -> str:
    """Return the house's name of ``Soll X [mm]``, ``x_ist`` or ``Actual X``, in millimetres where no unit of places is told; other heads as they are.

    ``below``: the unit that a row below the heads tells.
    """
    found = _TOLD.fullmatch(in_english(head))
    if found is None:
        return head
    if below and not found["unit"]:
        # Of a unit that is not known here it is no head that is.
        return of_words(f"{head} [{below.strip('[]() ')}]")
    what, axis = (found["what"] or found["what2"]).lower(), (found["axis"] or found["axis2"]).lower()
    # Errors are of any unit.
    unit = (found["unit"] or (NO_UNIT if _WORDS[what] == "error" else "mm")).lower()
    return f"{_WORDS[what]}_{axis}_{unit}"


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
