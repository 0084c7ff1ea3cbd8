"""What the heads of a table of a turning axis mean: time, angle, pulse, speed, probes, run-out."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from dtwin.units import LENGTHS_MM, TIMES_S, UM_PER_MM

TIME, ANGLE, PULSE, SPEED = "t_s", "angle_deg", "pulse_1", "speed_rpm"
PROBE = "probe"
PATH = "path"
RUNOUT = "runout"
"""How the house's name of a column of run-out begins."""
OVER_SPEED = "run-out over speed"
"""What the condition of a run states as its ``form`` when its samples are run-outs, not displacements."""
AXIAL = "axial"
RADIAL = "radial"

# Metres are no probe's.
_LENGTH_UM = {name: UM_PER_MM * mm for name, mm in LENGTHS_MM.items() if name != "m"}
_FACTORS: Mapping[str, Mapping[str, float]] = {
    TIME: TIMES_S,
    ANGLE: {"deg": 1.0, "°": 1.0, "rad": 57.29577951308232, "gon": 0.9, "rev": 360.0, "turns": 360.0},
    SPEED: {"rpm": 1.0, "1/min": 1.0, "min-1": 1.0, "min^-1": 1.0, "u/min": 1.0, "rev/min": 1.0, "r/min": 1.0}
    | {"1_min": 1.0, "hz": 60.0, "rps": 60.0, "rev/s": 60.0, "1/s": 60.0, "deg/s": 1.0 / 6.0, "deg_s": 1.0 / 6.0},
    PULSE: {"1": 1.0, "v": 1.0},
}
_USUAL = {TIME: "s", ANGLE: "deg", SPEED: "rpm", PULSE: "1"}
_WORDS = {
    TIME: re.compile(r"^(t|time|zeit|timestamp|elapsed)\b"),
    PULSE: re.compile(r"pulse|puls\b|index|trigger|tacho|once.per|keyphas|marker"),
    SPEED: re.compile(r"speed|\brpm\b|drehzahl|\bvel"),
    ANGLE: re.compile(r"angle|winkel|\bphi\b|\btheta\b|rotation|position.*(deg|°)"),
}
_RUNOUT = re.compile(r"run.?out|\btir\b|rundlauf|planlauf|\bf\.?i\.?m\b")
_PROBE = re.compile(r"displ|\bdisp\b|probe|radial|axial|face|gap|taster|weg\b|^[xyz]\d?$|cap\d|sensor")
_AXIAL = re.compile(r"axial|face|planlauf|^z\d?$")
_RADIAL = re.compile(r"radial|rundlauf|^[xy]\d?$")
_OTHER = re.compile(r"temp|cmd|act\b")
_PATH = re.compile(r"deviation|abweichung|\berr|fehler|target|soll|nominal|direction|richtung")
"""What a test of a path or a position tells, and one of a turning axis does not."""
_LETTER = re.compile(r"[xyz]\d?")
_UNITS = sorted({unit for known in (*_FACTORS.values(), _LENGTH_UM) for unit in known}, key=len, reverse=True)
_UNIT = re.compile(rf"(?:^|[\[(_\s/,])({'|'.join(map(re.escape, _UNITS))})\s*[\])]?\s*$")
_IN_BRACKETS = re.compile(r"[\[(]\s*([^\[\]()]+?)\s*[\])]\s*$")


@dataclass(frozen=True)
class Column:
    """What a head means.

    ``role``: ``t_s``, ``angle_deg``, ``pulse_1``, ``speed_rpm``; ``runout`` or ``probe``; ``path``; empty when it is
    none.
    ``name``: of a probe: its name, without the unit.
    ``factor``: to the unit of the role; of a probe, to µm; 0 where no unit is told.
    ``likely``: whether the words alone say so, or only a unit of length.
    """

    role: str
    name: str = ""
    factor: float = 0.0
    likely: bool = False


def column_of(head: str, unit_below: str = "") -> Column:
    """Return what a head means, with the unit that a row below the heads states."""
    text = " ".join(head.replace("_", " ").split()).lower()
    found = _UNIT.search(head.strip().lower())
    inside = _IN_BRACKETS.search(head.strip().lower())
    if found is not None and inside is not None and inside[1] not in _UNITS:
        # Of 1000 rpm it is the last word only.
        found = None
    told = unit_below.strip().strip("[]()").lower() or (found[1] if found else "")
    if "winkel" in text and "grad" in (told, inside and inside[1]):
        # Elsewhere than in German it may be 1/400 of a turn.
        told = "deg"
    words = (
        text if found is None else text[: len(text) - len(found[0].strip().replace("_", " ").strip())].strip(" [(/,")
    )
    if not words and found is not None:
        words = text
    if told not in _LENGTH_UM:
        for role, word in _WORDS.items():
            if word.search(words) or word.search(text):
                return Column(
                    role, factor=_FACTORS[role].get(told or (inside[1] if inside else _USUAL[role]), 0.0), likely=True
                )
        # A probe in volts is one without its scale, which is refused; what else is in volts is of no use here.
        if told and told not in _LENGTH_UM and not (_PROBE.search(words) and not _OTHER.search(words)):
            return Column("")
    name = re.sub(r"[^A-Za-z0-9.+-]+", "_", words).strip("_.-+") or "probe"
    scale = _LENGTH_UM.get(told, 0.0)
    if _RUNOUT.search(words):
        return Column(RUNOUT, name, scale, likely=True)
    if _PATH.search(words):
        return Column(PATH)
    if _OTHER.search(words):
        return Column("")
    likely = bool(_PROBE.search(words))
    return Column(PROBE, name, scale, likely) if scale or likely else Column("")


def direction_of(name: str) -> str:
    """Return ``axial`` or ``radial`` as the name of a probe says; empty when it says neither."""
    text = name.lower().replace("_", " ").strip()
    return AXIAL if _AXIAL.search(text) else RADIAL if _RADIAL.search(text) else ""


def is_turning(columns: list[Column]) -> bool:
    """Return whether columns are surely those of a turning axis: nothing but their words says so."""
    roles = {c.role for c in columns}
    if PATH in roles:
        return False
    if SPEED in roles and RUNOUT in roles:
        return True
    probes = [c for c in columns if c.role == PROBE and c.likely and c.factor]
    if TIME not in roles or not probes:
        return False
    # x, y and z beside a speed may be positions of axes.
    return bool(roles & {ANGLE, PULSE}) or (SPEED in roles and not all(_LETTER.fullmatch(c.name) for c in probes))
