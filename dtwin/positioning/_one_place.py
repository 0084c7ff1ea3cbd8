"""Readings of one place that was approached again and again: how it repeats, and no accuracy."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from dtwin.acquire.table_dialect import STATISTICS
from dtwin.acquire.xmlsafe import number_or_none
from dtwin.errors import InputError
from dtwin.positioning.scale import Scale
from dtwin.positioning.table_heads import is_index, plain_unit, told_unit
from dtwin.schema import Floats
from dtwin.statistics import f_tail

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
    got = f"{sum(map(len, groups))} readings, standard deviation {within:z.3g} {fine}, a next one lies within ± {2.0 * within:z.3g} {fine} (k = 2)"
    if len(groups) > 1:
        means = [float(group.mean()) for group in groups]
        names = (
            " and ".join(name for name in groups_um if name) if set(groups_um) <= {"forward", "reverse"} else "sessions"
        )
        got += f"; means of {names} differ by {max(means) - min(means):z.3g} {fine}"
    step, rest = _moves(groups)
    if step:
        got += f"; but they move by {step:+z.3g} {fine} from one reading to the next, and scatter by {rest:z.2g} {fine} about that: slip, lost steps, or heat, and a next one lies farther off"
    return InputError(
        "one target, however often: its readings tell how a place or a switch repeats, not how an axis positions",
        code="position_table.one_place",
        where=str(path),
        got=got,
        allowed="two targets or more",
        hint="the repeatability of a datum is what is got; for accuracy and R of an axis read five targets or more, from both sides",
    )
