"""What the heads of a table of a turning axis mean: time, angle, pulse, speed, probes, run-out."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from dtwin.acquire.foreign_columns import PROBES, in_english
from dtwin.errors import InputError
from dtwin.schema import Finding
from dtwin.units import LENGTHS_MM, TIMES_S, UM_PER_MM, with_shares

TIME, ANGLE, PULSE, SPEED = "t_s", "angle_deg", "pulse_1", "speed_rpm"
PROBE = "probe"
PATH = "path"
RUNOUT = "runout"
"""How the house's name of a column of run-out begins."""
OVER_SPEED = "run-out over speed"
"""What the condition of a run states as its ``form`` when its samples are run-outs, not displacements."""
AT_REST = "at rest"
"""The same when they were read at a few places of an axis that was turned by hand."""
AXIAL = "axial"
RADIAL = "radial"

# Metres are no probe's; a tenth of the workshop is one of a thou.
_LENGTH_UM = {name: UM_PER_MM * mm for name, mm in LENGTHS_MM.items() if name != "m"} | {"tenth": 2.54, "tenths": 2.54}
_RAD_DEG = math.degrees(1.0)
_TURNS_RPM = dict.fromkeys(
    (
        "rpm",
        "1/min",
        "/min",
        "min-1",
        "1_min",
        "u/min",
        "upm",
        "umdr/min",
        "rev/min",
        "r/min",
        "tr/min",
        "giri/min",
        "g/min",
        "转/分",
    ),
    1.0,
) | {"krpm": 1000.0}
"""Units that nothing but a speed of rotation has."""
_FACTORS: Mapping[str, Mapping[str, float]] = {
    TIME: TIMES_S,
    ANGLE: dict.fromkeys(("deg", "°", "degree", "degrees"), 1.0)
    | dict.fromkeys(("rad", "radian", "radians"), _RAD_DEG)
    | {"mrad": 1e-3 * _RAD_DEG, "gon": 0.9}
    | dict.fromkeys(
        ("rev", "revs", "revolutions", "turn", "turns", "umdrehung", "umdrehungen", "umdr", "tours", "giri"), 360.0
    ),
    SPEED: _TURNS_RPM
    | dict.fromkeys(("hz", "rps", "rev/s", "r/s", "u/s", "tr/s", "1/s", "s-1"), 60.0)
    | {"rad/s": _RAD_DEG / 6.0}
    | dict.fromkeys(("deg/s", "deg_s", "°/s"), 1.0 / 6.0),
    PULSE: {"1": 1.0, "v": 1.0},
}
_USUAL = {TIME: "s", ANGLE: "deg", SPEED: "rpm", PULSE: "1"}
_WORDS = {
    TIME: re.compile(
        r"^(t|date.?time|datum.{1,3}(?:uhr)?zeit|time|zeit|uhrzeit|zeitpunkt|timestamp|clock|elapsed|hours|minutes|seconds|stunden|minuten|sekunden|temps|heure|tiempo|hora|tempo|时间|時間|時刻)\b"
    ),
    PULSE: re.compile(r"pulse|puls\b|index|trigger|tacho|once.per|keyphas|marker"),
    SPEED: re.compile(
        r"speed|\brpm\b|drehzahl|\bvel|\bomega\b|vitesse|(?:rotat|dreh|spin).*fre[qk]uen|^(fre[qk]u|fréqu|frecu)en\w+$|转速|轉速|回転"
    ),
    ANGLE: re.compile(
        r"angle|winkel|angolo|[aá]ngulo|encoder.*(?:deg|°|rad|rev|turn)|角度|\bphi\b|\btheta\b|rotation|position.*(?:deg|°)"
    ),
}
_ERROR_MOTION = (
    ("A", "asynchronous error motion", re.compile(r"\ba.?synchron")),
    ("S", "synchronous error motion", re.compile(r"\bsynchron|\b(average|mean) error.motion")),
    ("T", "total error motion", re.compile(r"\btotal error.motion")),
    ("e", "once per turn", re.compile(r"\bfundamental|\bonce.per.(rev|turn)")),
    ("T", "error motion, taken as the total", re.compile(r"(?<!straightness )\berror.motion")),
)
"""Figures of ISO 230-7 beside the run-out, as tables over speed name them."""
_RUNOUT = re.compile(
    r"run.?out|\btir\b|rundlauf|planlauf|\bf\.?i\.?m\b|schlag\b|faux.?rond|voile|battement|\bsalto\b|oscillazione|跳动|跳動|振れ"
)
_NOT_READ = re.compile(
    r"predict|expect|simulat|toleran[cz]|\blimit|grenz(wert|e)\b|allow|zul[äa]ssig|permi(tted|ssible)|\bsoll|\bnominal|\bspec(ified)?\b|uncertaint|unsicherheit|\bstd|\bsigma\b|standard.?(dev|abw)"
)
"""What a head says of run-outs that nobody read."""
_COMPUTED = re.compile(
    r"predict|expect|simulat|\bideal|\bfit(ted)?\b|\b(mean|avg|average|mittel\w*)\b|residu|(?<!un)(correct|compensat|korrigiert|kompensiert)|command|amplitud"
    r"|filter|gefiltert|filtré|filtrad|(low|high|band).?pass|(tief|hoch|band)pass|smooth|geglättet|envelope|hüllkurve|\btrend|once.per|\ba?sync|\bform\b|formfehler|\bsumm?e?\b|differ|eccentric|exzentr|diamet|durchm|tangential|\bvelocity"
    r"|(?<!\w)[xyz]\d?\s*[-\u2212+/]\s*[xyz]\d?(?!\w)|\b(lsc|mic|mcc|mzc|fft)\b"
)
"""What a head says of a displacement that no probe read."""
_POSITION, _OF_POSITIONS = re.compile(r"\bpos(ition)?\b"), ("mm", "cm", "m", "in", "inch")
_PART = re.compile(
    r"/\s*2\b|±|\+\s*/\s*-|amplitud|\bhal(f|be)|\b(0|zero)\s*-?\s*(to)?\s*-?\s*p(ea)?k\b|\brms\b|effektiv", re.I
)
"""What a head says of a part of a run-out, which is from the lowest to the highest reading."""
_PROBE = re.compile(
    rf"displ|\bdisp\b|\b({PROBES})|radial|axial|face|gap|taster|weg\b|^d?[xyz]\d?$|cap\d|\bdial\b|indicator|comparateur"
)
_AXIAL = re.compile(r"axial|assial|face|planlauf|voile|轴向|端面|^d?z\d?$")
_RADIAL = re.compile(r"radial|rundlauf|径向|faux.?rond|^d?[xy]\d?$")
_OTHER = re.compile(r"temp|°\s*[cf]|℃|cmd|act\b")
_PATH = re.compile(r"deviation|abweichung|\berr|fehler|target|soll|nominal|direction|richtung")
"""What a test of a path or a position tells, and one of a turning axis does not."""
PLACES = re.compile(
    r"(position|location|place|stelle|mess(stelle|ort|punkt)|spindle|spindel|probe|sensor|sense|axis|achse|holder|halter|collet|spannzange|chuck|futter|arbor|bearing|lager)([\s._-]*(no|nr|id|number|nummer|name|#)\.?)?",
    re.I,
)
"""Head of a column that says where, or with what, the run-out of a row was read."""
DISTANCES = re.compile(
    r".*(distance|abstand|height|h[öo]he|depth|tiefe|stick.?out|overhang|auskrag|projection|from.(the.)?(nose|face)|(tool|bar|gauge|werkzeug).?(length|l[äa]nge)|load|force|belastung|kraft).*",
    re.I,
)
"""Head of a column of numbers that say where along the axis, or at which length of the tool, the run-out of a row was read."""
_LETTER = re.compile(r"d?[xyz]\d?")
_UNITS = sorted({unit for known in (*_FACTORS.values(), _LENGTH_UM) for unit in known}, key=len, reverse=True)
_UNIT = re.compile(rf"(?:^|[\[(_\s/,])({'|'.join(map(re.escape, _UNITS))})\s*[\])]?\s*$")
_FREQUENCY = re.compile(r"\W*(fre[qk]u|fréqu|frecu)", re.I)
_TIMES = re.compile(r"(?<![a-z])[x\u00d7*·]\s*10+\b|\b10(\^-?\d|[²³⁶])", re.I)
"""A unit that is a multiple of another one."""
_PLACE = re.compile(r"(\s|@)\d{2,}([.,]\d+)?$|\b(at|in|bei|à|@)\s*\d+([.,]\d+)?$", re.I)
_TENTHS = re.compile(r"\btenths?\b", re.I)
_IN_BRACKETS = re.compile(r"[\[(]\s*([^\[\]()]+?)\s*[\])]\s*$")


@dataclass(frozen=True)
class Column:
    """What a head means.

    ``role``: ``t_s``, ``angle_deg``, ``pulse_1``, ``speed_rpm``; ``runout`` or ``probe``; ``path``; empty when it is
    none.
    ``name``: of a probe: its name, without the unit.
    ``factor``: to the unit of the role; of a probe, to µm; 0 where no unit is told.
    ``likely``: whether the words alone say so, or only a unit of length.
    ``assumed``: the unit that is taken, where none is told.
    """

    role: str
    name: str = ""
    factor: float = 0.0
    likely: bool = False
    assumed: str = ""

    @property
    def is_tir(self) -> bool:
        """Whether a run-out is one, and no figure that was computed of the readings."""
        return figure_of(self.name)[0] == "TIR"


def column_of(head: str, unit_below: str = "") -> Column:
    """Return what a head means, with the unit that a row below the heads states."""
    head, unit_below = (
        in_english(cell).replace("⁻¹", "-1").replace("^-1", "-1").strip() for cell in (head, unit_below)
    )
    text = " ".join(head.replace("_", " ").split()).lower()
    if _TIMES.search(f"{head} {unit_below}"):
        return replace(column_of(*(_TIMES.sub("", cell) for cell in (head, unit_below))), factor=0.0)
    unit_said = _UNIT.search(head.lower())
    inside = _IN_BRACKETS.search(head.lower())
    if unit_said is not None and inside is not None and inside[1] not in _UNITS:
        # Of 1000 rpm it is the last word only.
        unit_said = None
    if (
        unit_said is not None
        and not unit_below
        and unit_said[0][0].isspace()
        and _PLACE.search(head[: unit_said.start()])
    ):
        # Of "run-out at 300 mm" it is that of the place.
        return replace(column_of(head[: unit_said.start()]), factor=0.0)
    told = unit_below.strip("[]()").lower() or (unit_said[1] if unit_said else "")
    if "winkel" in text and "grad" in (told, inside and inside[1]):
        # Elsewhere than in German it may be 1/400 of a turn.
        told = "deg"
    words = (
        text
        if unit_said is None
        else text[: len(text) - len(unit_said[0].strip().replace("_", " ").strip())].strip(" [(/,")
    )
    if not words and unit_said is not None:
        words = text
    # Of "run-out in µm" the last word is none of the name.
    words = re.sub(r"\s+in$", "", words)
    if told not in _LENGTH_UM:
        if told in _TURNS_RPM:
            return Column(SPEED, factor=_TURNS_RPM[told], likely=True)
        for role, word in _WORDS.items():
            if word.search(words) or word.search(text):
                unit = told or (inside[1] if inside else "")
                usual = "" if unit else _USUAL[role]
                return Column(role, factor=_FACTORS[role].get(unit or usual, 0.0), likely=True, assumed=usual)
        # A probe in volts is one without its scale, which is refused; what else is in volts is of no use here.
        if told and told not in _LENGTH_UM and not (_PROBE.search(words) and not _OTHER.search(f"{words} {told}")):
            return Column("")
    name = re.sub(r"[^\w.+-]+", "_", words).strip("_.-+") or "probe"
    scale = _LENGTH_UM.get(told, 0.0)
    if _RUNOUT.search(words) or figure_of(words)[0] != "TIR":
        return Column("") if _NOT_READ.search(words) else Column(RUNOUT, name, scale, likely=True)
    if _PATH.search(words):
        return Column(PATH)
    moves = told in _OF_POSITIONS and _POSITION.search(words)
    if _OTHER.search(f"{words} {told}") or _NOT_READ.search(words) or _COMPUTED.search(words) or moves:
        return Column("")
    likely = bool(_PROBE.search(words))
    return Column(PROBE, name, scale, likely) if scale or likely else Column("")


def figure_of(name: str) -> tuple[str, str]:
    """Return symbol and name of the figure that a column over speed holds, by its name: of error motion, else run-out."""
    text = name.lower().replace("_", " ")
    return next(((symbol, said) for symbol, said, word in _ERROR_MOTION if word.search(text)), ("TIR", "run-out"))


def require_whole(heads: Sequence[str], columns: Sequence[Column], path: Path) -> None:
    """Refuse run-outs of which the head says that they are a part of it: half of it, as ``± 3 µm``, or its RMS."""
    part = [h for h, c in zip(heads, columns, strict=True) if c.role == RUNOUT and _PART.search(h.replace("_", " "))]
    if part:
        raise InputError(
            "a column holds a part of a run-out: an amplitude, or an RMS",
            code="rotation.part",
            where=str(path),
            got=", ".join(part)[:120],
            allowed="the run-out (TIR): from the lowest to the highest reading of a turn",
            hint="of amplitudes write twice as much under the head run-out [µm]",
        )


def assumed_of(cells: Sequence[str], columns: Mapping[str, Column]) -> tuple[Finding, ...]:
    """Return what is assumed of heads and units: which tenths are meant, and units of ``columns``, by their heads."""
    units = [f"{head} in {column.assumed}" for head, column in columns.items() if column.assumed not in ("", "1")]
    said = f"columns tell no unit, and are taken: {', '.join(units)}"
    findings = (Finding("rotation.unit_assumed", "info", said),) if units else ()
    if named := [head for head, column in columns.items() if column.role == SPEED and _FREQUENCY.match(head)]:
        said = f"{named[0]} is taken for turns a second: neither a spectrum, nor what feeds a motor of several pairs of poles"
        findings = (*findings, Finding("rotation.frequency", "warning", said))
    if not any(_TENTHS.search(with_shares(cell)) for cell in cells):
        return findings
    return (*findings, Finding("rotation.tenths", "info", "tenths are taken for ten-thousandths of an inch, 2.54 µm"))


def direction_of(name: str) -> str:
    """Return ``axial`` or ``radial`` as the name of a probe says; empty when it says neither."""
    text = name.lower().replace("_", " ").strip()
    return AXIAL if _AXIAL.search(text) else RADIAL if _RADIAL.search(text) else ""


def is_dial(columns: list[Column]) -> bool:
    """Return whether columns are angles and what an indicator reads there, and nothing else that says how the axis turned."""
    roles = {c.role for c in columns}
    probes = [c for c in columns if c.role in (PROBE, RUNOUT)]
    alone = ANGLE in roles and not roles & {TIME, SPEED, PULSE, PATH}
    return alone and bool(probes) and all(c.likely and c.factor and not _LETTER.fullmatch(c.name) for c in probes)


def is_turning(columns: list[Column]) -> bool:
    """Return whether columns are surely those of a turning axis: nothing but their words says so."""
    roles = {c.role for c in columns}
    if PATH in roles:
        return False
    if SPEED in roles and RUNOUT in roles:
        return True
    probes = [c for c in columns if c.role in (PROBE, RUNOUT) and c.likely and c.factor]
    if not probes:
        return False
    # x, y and z beside a speed may be positions of axes.
    at_speed = SPEED in roles and not all(_LETTER.fullmatch(c.name) for c in probes)
    return (at_speed or bool(roles & {ANGLE, PULSE})) if TIME in roles else (at_speed and ANGLE in roles)
