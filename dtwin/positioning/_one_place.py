"""Readings of one place that was approached again and again: how it repeats, and no accuracy; targets that a control measured itself, which jitter."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from dtwin.acquire.table_dialect import STATISTICS
from dtwin.acquire.xmlsafe import number_or_none
from dtwin.errors import InputError
from dtwin.positioning.assignments import Reading
from dtwin.positioning.table_heads import is_index, plain_unit, told_unit
from dtwin.positioning.ways import Scale
from dtwin.schema import Floats
from dtwin.statistics import f_tail
from dtwin.units import shown_number

_COUNTS = re.compile(
    r"^(trial|run|cycle|repeat|repetition|approach|test|home|homing|session|series|day|versuch|messung|zyklus|lauf|anfahrt|serie|sitzung|essai|prova)"
    r"[\s_.]*(no|nr|num|number|nummer|index|id|#)?\.?$",
    re.I,
)
_SESSION = re.compile(r"session|series|day|serie|sitzung", re.I)
_READ = re.compile(
    r"read|measured|actual|ist|mess|position|deviation|error|abw|fehler|probe|indicator|dial|switch|schalter", re.I
)
_PROBED = re.compile(r"\bat (-?[\d.]+, ?-?[\d.]+) (?:is|bed will contact at) z=(-?\d+\.?\d*)", re.I)
"""Line of the console of a printer: where it probed its bed, and the height in mm."""
_OTHER = re.compile(STATISTICS, re.I)
_FEWEST = 5
_CHANCE = 1e-3
"""How often readings that only scatter may be said to move."""


def trials_of(rows: Sequence[Sequence[str]], scale: Scale) -> Mapping[str, Sequence[float]]:
    """Return the readings by session of a table of trials and one reading each, which says of no place where it should be; else nothing."""
    for begin, row in enumerate(rows[:20]):
        heads = [cell.strip() for cell in row]
        counts = [i for i, head in enumerate(heads) if _COUNTS.match(head) or is_index(head)]
        read = [i for i, head in enumerate(heads) if head and i not in counts]
        if (
            not any(map(_COUNTS.match, heads))
            or len(read) != 1
            or not _READ.search(heads[read[0]])
            or _OTHER.search(heads[read[0]])
        ):
            continue
        unit = plain_unit(told_unit(heads[read[0]], ""))
        factor = scale.factor(unit) if unit else float("nan")
        session = next((i for i in counts if _SESSION.match(heads[i])), None)
        told: dict[str, list[float]] = {}
        for line in rows[begin + 1 :]:
            value = number_or_none(line[read[0]]) if read[0] < len(line) else None
            if value is not None and factor > 0.0:
                name = line[session].strip() if session is not None and session < len(line) else ""
                told.setdefault(name, []).append(value * factor * scale.per)
        if sum(map(len, told.values())) >= _FEWEST:
            return told
    return {}


def probings_of(text: str) -> Mapping[str, Sequence[float]]:
    """Return in µm, by place, the heights that a printer's console says its probe found; nothing where no place has several."""
    told: dict[str, list[float]] = {}
    for place, height in _PROBED.findall(text):
        told.setdefault(place, []).append(float(height) * 1e3)
    return {place: heights for place, heights in told.items() if len(heights) >= _FEWEST}


def _moves(groups: Sequence[Floats]) -> tuple[float, float]:
    """Return by how much readings move from one to the next, and the standard deviation about that; 0 where they do no more than chance leaves."""
    at = np.concatenate([np.arange(len(g)) - (len(g) - 1) / 2.0 for g in groups])
    off = np.concatenate([g - g.mean() for g in groups])
    dof = len(off) - len(groups) - 1
    if dof < 1 or not off.any():
        return 0.0, 0.0
    step = float(at @ off / (at @ at))
    rest = float(np.sum((off - step * at) ** 2)) / dof
    ratio = step**2 * float(at @ at) / max(rest, 1e-12)
    return (step, float(np.sqrt(rest))) if f_tail(ratio, (1.0, float(dof))) < _CHANCE else (0.0, 0.0)


def one_place(path: Path, groups_um: Mapping[str, Sequence[float]], fine: str) -> InputError:
    """Return the refusal of readings of one place, with how they repeat; ``groups_um``: by direction, session or place, in ``fine``."""
    groups = [np.array(group) for group in groups_um.values() if len(group)]
    dof = sum(len(group) - 1 for group in groups)
    within = float(np.sqrt(sum(float(np.sum((g - g.mean()) ** 2)) for g in groups) / dof)) if dof else float("nan")
    got = f"{sum(map(len, groups))} readings, standard deviation {shown_number(within)} {fine}, a next one lies within ± {shown_number(2.0 * within)} {fine} (k = 2)"
    if len(groups) > 1:
        means = [float(group.mean()) for group in groups]
        names = (
            " and ".join(name for name in groups_um if name) if set(groups_um) <= {"forward", "reverse"} else "sessions"
        )
        got += f"; means of {names} differ by {shown_number(max(means) - min(means))} {fine}"
    step, rest = _moves(groups)
    if step:
        got += f"; but they move by {shown_number(step, sign='+')} {fine} from one reading to the next, and scatter by {shown_number(rest, 2)} {fine} about that: slip, lost steps, or heat, and a next one lies farther off"
    return InputError(
        "one target, however often: its readings tell how a place or a switch repeats, not how an axis positions",
        code="position_table.one_place",
        where=str(path),
        got=got,
        allowed="two targets or more",
        hint="the repeatability of a datum is what is got; for accuracy and R of an axis read five targets or more, from both sides",
    )


_CLOSE_MM = 0.01
"""Of an axis that turns, degrees, as all targets here."""
_FARTHER = 20.0
"""Times the width of a group of targets that another group lies off it at least."""


def joined_targets(targets_mm: Iterable[float]) -> dict[float, float]:
    """Return what each target is taken as: those that lie far closer to each other than the others are one, their mean to 0.1 µm."""
    told = np.array(sorted(set(targets_mm)))
    gaps = np.diff(told)
    groups = np.split(told, np.flatnonzero(gaps > _CLOSE_MM) + 1)
    between, width = gaps[gaps > _CLOSE_MM], max((float(np.ptp(g)) for g in groups if g.size), default=0.0)
    if not between.size or width == 0.0 or between.min() < _FARTHER * width:
        return {float(target): float(target) for target in told}
    return {float(target): round(float(group.mean()), 4) for group in groups for target in group}


def with_joined_targets(readings: Sequence[Reading]) -> tuple[Sequence[Reading], float]:
    """Return readings at the targets that were meant, and by how much the others were off them at most.

    Where one sweep was at two that would be one, they are two.
    """
    one = joined_targets(reading[0] for reading in readings)
    joined = [(one[r[0]], *r[1:]) for r in readings]
    if len({r[:3] for r in joined}) < len({r[:3] for r in readings}):
        return readings, 0.0
    return joined, max((abs(target - told) for told, target in one.items()), default=0.0)
