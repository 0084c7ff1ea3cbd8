"""Tables of poses with a row for each axis, ``pose, axis, target [mm], measured [mm]``: the three rows of a pose become one; heads in several rows, as cameras and ROS write them, too."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

from dtwin.acquire.axis_titles import AXIS_OF_ROW, axis_by_row
from dtwin.acquire.foreign_columns import below_heads, in_english
from dtwin.errors import InputError
from dtwin.kinds.poses._repeats import COUNTS, PLACES
from dtwin.units import LENGTHS_MM

_MOST_TITLES = 20
_XYZ = ("X", "Y", "Z")
_AXES = ("x", "y", "z")
_FEWEST, FEWEST_OF_ARM = 3, 5
"""Joints of an arm; so many are of nothing else, whatever stands beside them."""
_UNIT = re.compile(r"(\s*[\[(/].*|_[mnµu]?m)?$")
_Rows = Sequence[Sequence[str]]


def axes_beside(rows: _Rows, path: Path) -> _Rows:
    """Return a table whose axes stand beside each other; another one as it is.

    Raises ``InputError`` when rows of axes do not make poses of X, Y and Z each.
    """
    beside = _found(rows)
    if beside is None:
        return rows
    begin, axis, heads, units, body = beside
    values = [n for n, head in enumerate(heads) if n != axis and _of_axis(head, "X") is not None]
    kept = [n for n in range(len(heads)) if n != axis and n not in values]
    keys = [n for n in kept if PLACES.fullmatch(heads[n]) or COUNTS.fullmatch(heads[n])]
    told = [f"{heads[n]} [{units[n]}]" if n < len(units) and units[n].strip() else heads[n] for n in range(len(heads))]
    names = [told[n] for n in kept] + [str(_of_axis(told[n], letter)) for n in values for letter in _XYZ]
    made: list[Sequence[str]] = [*rows[:begin], names]
    for pose in _poses(body, axis, keys, path):
        by_axis = {row[axis].strip().upper(): row for row in pose}
        made.append([*(pose[0][n] for n in kept), *(by_axis[letter][n] for n in values for letter in _XYZ)])
    return made


def is_by_axes(rows: _Rows) -> bool:
    """Return whether a table begins with the rows of the three axes of a pose, commanded and measured."""
    begin = axis_by_row(rows)
    said = [_of_axis(head.strip(), "X") for head in rows[begin[0]]] if begin is not None else []
    return {"target"} < {of_words(head).partition("_")[0] for head in said if head is not None}


def _found(rows: _Rows) -> tuple[int, int, list[str], Sequence[str], list[list[str]]] | None:
    """Return the row of the heads, the column of the axis, heads, units below them, and rows; None of another table."""
    for begin, row in enumerate(rows[:_MOST_TITLES]):
        heads = [cell.strip() for cell in row]
        axis = next((n for n, head in enumerate(heads) if AXIS_OF_ROW.fullmatch(head)), None)
        if axis is None:
            continue
        units, below = below_heads([list(line) for line in rows], begin)
        body = [line for line in below if len(line) == len(heads) and any(cell.strip() for cell in line)]
        letters = {line[axis].strip().upper() for line in body}
        if body and letters <= set(_XYZ) and len(letters) > 1 and any(_of_axis(head, "X") for head in heads):
            return begin, axis, heads, units or (), body
    return None


def _of_axis(head: str, letter: str) -> str | None:
    """Return the head of one axis, ``target [mm]`` as ``target X [mm]``; None of a column that is no place."""
    said = _UNIT.sub(lambda unit: f" {letter}{unit[0]}", in_english(head), count=1)
    return said if of_words(said) != said else None


def _poses(body: list[list[str]], axis: int, keys: Sequence[int], path: Path) -> list[list[list[str]]]:
    """Return the rows of each pose: three that follow each other, or that have one name and number."""

    def whole(pose: list[list[str]]) -> bool:
        letters = sorted(row[axis].strip().upper() for row in pose)
        return letters == list(_XYZ) and len({tuple(row[n].strip() for n in keys) for row in pose}) == 1

    following = [body[n : n + 3] for n in range(0, len(body), 3)]
    if all(map(whole, following)):
        return following

    def key(row: list[str]) -> tuple[str, ...]:
        return tuple(row[n].strip() for n in keys)

    first = {name: n for n, name in reversed(list(enumerate(map(key, body))))}
    named = [list(pose) for _, pose in groupby(sorted(body, key=lambda row: first[key(row)]), key)] if keys else []
    if named and all(map(whole, named)):
        return named
    wrong = next(pose for pose in (named or following) if not whole(pose))
    raise InputError(
        "rows of axes do not make poses",
        code="poses.axes",
        where=str(path),
        got="; ".join(", ".join(cell.strip() for cell in row) for row in wrong[:4])[:160],
        allowed="a row of X, of Y and of Z for each pose, one after the other, or with the pose's name and number of repeat",
        hint="or one row a pose: target_x_mm, target_y_mm, target_z_mm, measured_x_mm, …",
    )


_MOST_HEADS = 12
_UNITS = {"meters": "m", "millimeters": "mm", "m": "m", "mm": "mm"}
_ROS = re.compile(r"(?:.*[./ ])?(position|translation|orientation|rotation)[./]([xyzw])$", re.I)
_WORDS = {
    **dict.fromkeys(("soll", "target", "nominal", "nom", "desired", "command", "commanded", "cmd"), "target"),
    **dict.fromkeys(("error", "err", "deviation", "dev", "fehler", "abweichung"), "error"),
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
_JOINT = re.compile(
    r"(?:j|q|a|theta|th|joint|axis|gelenk|achse)[ _.-]*(\d)(?:[ _]*[\[(/_]? *(?P<unit>deg(?:rees?)?|\u00b0|rad(?:ians?)?)[\])]?)?",
    re.I,
)
_TRACKER = re.compile(r"u ?\(95\).*", re.I)
"""Head of the uncertainty that the program of a laser tracker writes beside a place."""
_RTDE = re.compile(r"(target|actual)_q_([0-5])$")
"""Joints as a recording of a UR's RTDE has them, in radians."""
_VICON = re.compile(r".* T?([XYZ])$")


def joined(rows: Sequence[Sequence[str]]) -> tuple[list[str], list[Sequence[str]], str] | None:
    """Return heads, rows below them and the unit of lengths of an export of OptiTrack Motive or Vicon; None of another file.

    Above a row that begins with ``Frame`` stand names, and, of OptiTrack, what a column is: ``tool Position.X``, ``tool TX``.
    """
    begin = next((n for n, row in enumerate(rows[:_MOST_HEADS]) if row and row[0].strip().lower() == "frame"), 0)
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
    """Return whether heads are those of a pose as ROS flattens it, ``pose.position.x``, or of joints as RTDE records them."""
    return any(_ROS.match(head.strip()) or _RTDE.match(head.strip()) for head in heads)


def of_words(head: str, below: str = "") -> str:
    """Return the house's name of ``Soll X [mm]``, ``x_ist`` or ``Actual X``, in millimetres where no unit of places is told; other heads as they are.

    ``below``: the unit that a row below the heads tells.
    """
    match = _TOLD.fullmatch(in_english(head))
    if match is None:
        return head
    if below and not match["unit"]:
        # Of a unit that is not known here it is no head that is.
        return of_words(f"{head} [{below.strip('[]() ')}]")
    what, axis = (match["what"] or match["what2"]).lower(), (match["axis"] or match["axis2"]).lower()
    # Errors are of any unit.
    unit = (match["unit"] or (NO_UNIT if _WORDS[what] == "error" else "mm")).lower()
    return f"{_WORDS[what]}_{axis}_{unit}"


def joints_of(heads: Sequence[str], units: Sequence[str]) -> dict[int, str]:
    """Return the house's names, by column, of joints that heads such as ``j1``, ``A1 [deg]`` or ``theta_1`` tell, counted without a gap from 1, or,
    as ``q_0`` to ``q_5``, from 0.

    Of a quaternion, ``Q0`` to ``Q3`` or ``q1`` to ``q4``, there are none. ``units``: those in a row below the heads.
    """
    matches = {n: match for n, head in enumerate(heads) if (match := _JOINT.fullmatch(head.strip())) is not None}
    counted = sorted(int(match[1]) for match in matches.values())
    first = 0 if counted[:1] == [0] else 1
    quaternion = len(matches) == 4 and all(match[0].lower().startswith("q") for match in matches.values())
    fewest = _FEWEST if first else FEWEST_OF_ARM
    if counted != list(range(first, first + len(matches))) or len(matches) < fewest or quaternion:
        return {}
    told = {
        n: (match["unit"] or (units[n] if n < len(units) else "")).strip("[]() ").lower()
        for n, match in matches.items()
    }
    unit = {
        n: "rad" if t.startswith("rad") else "deg" if t.startswith(("deg", "\u00b0")) else NO_UNIT
        for n, t in told.items()
    }
    return {n: f"joint_{int(match[1]) + 1 - first}_{unit[n]}" for n, match in matches.items()}


def places_of(heads: Sequence[str], units: Sequence[str]) -> dict[int, str]:
    """Return the house's names, by column, of plain ``X [mm]``, ``Y [mm]`` and ``Z [mm]`` as measured places; empty when one tells no unit."""
    out = {}
    for n, head in enumerate(heads):
        match = _TOLD.fullmatch(in_english(f"measured {head.strip()}"))
        if (
            match is not None
            and head.strip()[:1].lower() in _AXES
            and (match["unit"] or (n < len(units) and units[n].strip()))
        ):
            out[n] = of_words(f"measured {head.strip()}", units[n] if n < len(units) else "")
    return out if len(out) == len(_XYZ) else {}


def of_tracker(heads: Sequence[str]) -> bool:
    """Return whether heads are those of places that the program of a laser tracker wrote with their uncertainty."""
    return bool(places_of(heads, ())) and any(_TRACKER.fullmatch(head.strip()) for head in heads)


def lines_for(heads: Sequence[str], unit: str) -> list[str]:
    """Return lines of ``[campaign.instrument.columns]`` that would name foreign heads as measured ones; empty when none is known."""
    joints = [match for head in heads if (match := _RTDE.match(head.strip())) is not None]
    asked = "target" if any(match[1] == "target" for match in joints) else "actual"
    out = [f'"{match[0]}" = "joint_{int(match[2]) + 1}_rad"' for match in joints if match[1] == asked]
    for head in heads:
        ros, vicon = _ROS.match(head), _VICON.match(head)
        if ros is not None and ros[1].lower() in ("position", "translation") and ros[2].lower() != "w":
            out.append(f'"{head}" = "measured_{ros[2].lower()}_{unit}"')
        elif ros is not None:
            out.append(f'"{head}" = "measured_q{ros[2].lower()}"')
        elif vicon is not None:
            out.append(f'"{head}" = "measured_{vicon[1].lower()}_{unit}"')
    return out
