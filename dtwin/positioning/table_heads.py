"""What the heads and cells of a positioning table say: targets, directions, cycles, units."""

from __future__ import annotations

import re
import unicodedata
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from dtwin.acquire.foreign_columns import is_number
from dtwin.acquire.table_dialect import STATISTICS
from dtwin.acquire.title_words import REVERSED
from dtwin.positioning.matrix import names_sense
from dtwin.positioning.ways import IN_BRACKETS, SIGNS, Scale, way_of
from dtwin.units import ANGLES_DEG, LENGTHS_MM, with_shares

MOST_TITLES = 20
NAMED = "target: "
"""What a head of angles is given to be one of targets; nobody wrote it."""
MISSING = frozenset(("", "nan", "n/a", "na", "#n/a", "#nv", "-", "--", "---", "null", "none", "out of range"))
_ANGLES = "deg|grad|gon|mdeg|arc ?sec|arc ?min|[mµμu]?rad"
ANGLE = re.compile(rf"[\[(_\s/]({_ANGLES})[\])]?$|°(?!\s*[CF])|^[\[(]?({_ANGLES})[\])]?$", re.I)
TURNS = re.compile(r"[ABC]\d?", re.I)
MOVES = re.compile(r"[XYZUVW]\d?", re.I)
"""Names of axes that turn, and of those that move along, after ISO 841."""
_OF_POSITIONS = 0.5
"""Of the unit of targets: in smaller units there are deviations."""
_UNITS = "|".join(sorted((*LENGTHS_MM, *ANGLES_DEG), key=len, reverse=True))
SUMS_UP = re.compile(rf"\b({STATISTICS}|median|spread|\d?s)\b|x̄|\u03c3|°\s*[CF]|℃", re.I)
"""Words of a column that sums up the readings beside it, or is a temperature."""
AXIS = re.compile(
    r"^(axis|achse|axe|asse|eje|machine|maschine|macchina|m[aá]quina|stage|slit|blade|jaw|backe|joint|gelenk|robot|roboter|head|kopf|unit|device|module|actuator|table|rundtisch|ger[aä]t|s/?n|(serial|serien)[\s-]*(no|nr|number|nummer)?\.?)([\s._-]*(no|nr|id|number|nummer|name|#)\.?)?$",
    re.I,
)
"""Head of a column that says of which axis, or of which of several alike, a row is."""
_OF_AXIS = re.compile(
    r"(?<![a-z])(axis|achse|axe|asse|eje|machine|maschine|macchina|m[aá]quina|stage|slit|blade|jaw|backe|joint|gelenk|robot|roboter|head|kopf|unit|module|actuator|table|rundtisch|lathe|mill|s/?n|serial|spindle|spindel)[\s._:#-]*(\d+|[xyzabcuvw])(?![a-z0-9])",
    re.I,
)
"""In a head or a title: of which axis, or of which of several alike, a column is."""
_NAMED = re.compile(r"([XYZUVWABCJM])\d(?=[\s_]+[a-z])")
"""At the begin of a head: the name of one of several axes that go the same way, or of a machine."""
UNIT_INSIDE = re.compile(rf"\s*[\[(]\s*({_UNITS})\s*[\])]", re.I)
_UNIT = re.compile(rf"[_\s/,]({_UNITS})\s*$", re.I)
_VALUE = re.compile(r"(\d+|[+-]?\d*[.,]\d+)(e[+-]?\d+)?", re.I)
_COUNTS = re.compile(r"[\d\s,.]*|[ijkn](\s*,\s*[ijkn\d]+)*", re.I)
_ONE = r"(?![a-z])(?![\s_]*[xyz](?![a-z]))"
"""Behind a word that is cut short, which with a letter of an axis is a part of a place: ``cmd_z_mm``."""
_WANTED = rf"set ?point|set(?=[\s_]*pos|[\s_]*[\[(]?({_UNITS})\b)|(demand|desired|requested|goal){_ONE}"
_TARGET = re.compile(
    rf"^(i\b|[px]_?i\b|target|tgt|nominal|command|cmd(pos)?{_ONE}|position|pos(?!itiv)|{_WANTED}|soll|ziel|punkt|cible|consigne|目标|目標|指令)",
    re.I,
)
SURELY_TARGET = re.compile(
    rf"^([px]_?i\b|target|tgt|nominal|command|cmd(pos)?{_ONE}|{_WANTED}|soll|ziel|cible|consigne|目标|目標|指令)", re.I
)
_INDEX = re.compile(
    r"#$|i\b|(\w*(target|point|punkt|pos\w*|mess\w*))?[ ._]*(no|nr|num|number|nummer|index)\b\.?$", re.I
)
_COUNTED = re.compile(r"(target|point|punkt|pos\w*|soll\w*|ziel\w*)[ ._]+i", re.I)
"""Head of a column of targets, or, where another one holds them, of their numbers."""
_DEVIATION = re.compile(r"dev(?!ic)|err|abw|fehler|[eé]cart|scost|desv|偏差|误差|誤差", re.I)
_CORRECTION = re.compile(r"((correct|[ck]ompensat)ion|korrektur)\b|(?<![^\W_])[ck]o(rr|mp)(?![^\W_])", re.I)
_NOT_READ = re.compile(
    r"toleran[cz]|\blimit|grenz(e|wert)|allow|zul[äa]ssig|permi(tted|ssible)|uncertaint|unsicherheit|±|following|schlepp|predict|expect|vorhers|simulat|smooth|gegl[äa]tt|\brms\b|squared|increment|(?<![^\W_])(abs|yaw|roll)(?![^\W_])|^\||nominal[\s_]+(err|dev|abw|fehl)|\bcode\b|standard.?(dev|abw)",
    re.I,
)
"""What a head says of errors that are no readings of the axis' place."""
_BARE = re.compile(r"(positioning |position |positions)?(error|deviation|dev\.?|abweichung|fehler)", re.I)
OTHER_TEST = re.compile(
    r"straightness|geradheit|flatness|ebenheit|squareness|rechtwinkl|angular|\bE([XYZ])(?!\1)[XYZ]\b|\bE[ABC][XYZ]\b",
    re.I,
)
"""Title of another test that is made along an axis."""
OWN_SENSOR = re.compile(r"resolver|encoder|open ?loop|motor|stepper|counter|dreh(geber|impuls)", re.I)
"""What reads for the control itself."""
_MEASURED = "mesur|misur|medi(d[ao]|ci)"
_ACTUAL = re.compile(rf"actual|measured|reading|ist|mess|ref|{_MEASURED}|(?<![a-z])(act|meas)(pos)?{_ONE}", re.I)
SURELY_READ = re.compile(
    rf"^(actual|measured?|measurement|reading|ist|mess|{_MEASURED}|(act|meas)(pos)?{_ONE}|\d{{1,3}}\s*[\[(])", re.I
)
CYCLE = re.compile(
    r"^(cycle|run|repeat|test( ?(no\.?|nr\.?|number|#))?$|(messreihe|s[ée]rie|ciclo)$|zyklus|lauf|nr)", re.I
)
_RUN = re.compile(r"r\d+(?!\w)", re.I)
_NUMBER = re.compile(r"(\d+)")
_WAY = re.compile(r"^(direction|dir|\w*richtung|bewegung$|movement$|approach|sens[eo]?\b|sentido)", re.I)

_SIGN_INSIDE = re.compile(r"(?<=[^\W\d_])\s*([+\-\u2212↑↓])(?=[\s\d]|[^\W_])")
"""A sign between the words of a head: ``Error + run 1``."""


@dataclass(frozen=True)
class Wide:
    """Columns of a table with several readings a row.

    ``cells``: column, direction and cycle; 0 where the row says the cycle, in column ``cycle`` or by how often its target came.
    """

    target: int
    cells: tuple[tuple[int, str, int], ...]
    cycle: int | None = None


def wide_of(heads: Sequence[str]) -> Wide | None:
    """Return which column is which in a table of one row a target, or of one row a target and cycle; None when it is neither."""
    names = [with_shares(head.strip()) for head in heads]
    targets = _targets(names)
    ways = _ways_of(names)
    told = [(i, ways[i], re.search(r"(\d+)", name)) for i, name in enumerate(names) if i not in targets[:1]]
    cycle = next((i for i, name in enumerate(names) if CYCLE.match(name) and way_of(name) is None), None)
    cells = [(i, way, number) for i, way, number in told if way and _is_read(names[i])]
    numbered = [(i, way, int(number[1])) for i, way, number in cells if number]
    # Positions and their deviations may stand beside each other.
    deviations = [cell for cell in numbered if is_deviation(names[cell[0]])]
    if 2 * len(deviations) == len(numbered) and {cell[1:] for cell in deviations} == {cell[1:] for cell in numbered}:
        numbered = deviations
    # Targets that lie on their side: a minus of theirs is no way back.
    if not targets or any(_VALUE.fullmatch(name) for name in names):
        return None
    # What was measured is no target of positions: that stands in a head that tells a direction.
    measured = _ACTUAL.search(names[targets[0]]) and not SURELY_TARGET.match(names[targets[0]])
    if measured and not all(is_deviation(names[i]) for i, _, _ in cells):
        return None
    # Of heads in two rows, as under merged cells, some are empty.
    whole = all(names[: cells[-1][0]]) if cells else False
    if sorted(way for _, way, _ in cells) == ["forward", "reverse"] and whole and (cycle is not None or not numbered):
        return Wide(targets[0], tuple((i, way, 0) for i, way, _ in cells), cycle)
    if whole and not numbered and cycle is None and _alike(names, cells):
        seen: Counter[str] = Counter()
        return Wide(targets[0], tuple((i, way, seen.update([way]) or seen[way]) for i, way, _ in cells))
    # Cycles may be counted from 0.
    shift = 1 if any(number == 0 for _, _, number in numbered) else 0
    counted = tuple((i, way, number + shift) for i, way, number in numbered)
    return Wide(targets[0], counted) if len(counted) >= 2 and not _has_more(names, counted, targets[0]) else None


def _has_more(names: Sequence[str], counted: Sequence[tuple[int, str, int]], target: int) -> bool:
    """Return whether beside readings of one direction as many columns of their unit stand, of another one whose name is not known."""
    read = [i for i, _, _ in counted]
    if len({way for _, way, _ in counted}) > 1:
        return False
    others = [
        _NUMBER.sub("", name)
        for i, name in enumerate(names)
        if i not in (*read, target) and _NUMBER.search(name) and unit_of(name) == unit_of(names[read[0]])
        if not SUMS_UP.search(name) and not is_index(name)
    ]
    return len(read) in Counter(others).values()


def _ways_of(names: Sequence[str]) -> list[str | None]:
    """Return the direction that each head names; a sign within it is one where each head stands there with either sign."""
    ways = [way_of(name) for name in names]
    bare = [re.sub(r"[\W\d_]", "", IN_BRACKETS.sub("", name)).lower() for name in names]
    if len({name for name, way in zip(bare, ways, strict=True) if len(name) == 1 and way is None}) > 1:
        # Of columns A to F the letters B and F are no directions.
        ways = [None if len(name) == 1 else way for name, way in zip(bare, ways, strict=True)]
    if {name for name, way in zip(bare, ways, strict=True) if way} == {"r"}:
        # Alone, R1 may be a run or a reading.
        ways = [None] * len(names)
    signs = [_SIGN_INSIDE.search(IN_BRACKETS.sub("", name)) for name in names]
    marked = [(name.replace(sign[1], "", 1), SIGNS[sign[1]]) for name, sign in zip(names, signs, strict=True) if sign]
    if any(ways) or not marked:
        return ways
    both = [sorted(name for name, way in marked if way == wanted) for wanted in ("forward", "reverse")]
    return [SIGNS[sign[1]] if sign else None for sign in signs] if both[0] == both[1] else ways


def _alike(names: Sequence[str], cells: Sequence[tuple[int, str, object]]) -> bool:
    """Return whether several columns of either way are called alike: cycles that are not numbered."""
    heads = {way: [names[i] for i, told, _ in cells if told == way] for way in ("forward", "reverse")}
    return len(heads["forward"]) == len(heads["reverse"]) > 1 and all(len(set(told)) == 1 for told in heads.values())


def axes_beside(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the axes, or machines, that cells of one row name, as heads of columns beside each other; empty where they are of one."""
    for row in rows:
        letters = [match for cell in row if (match := _NAMED.match(cell.strip())) is not None]
        if len({match[0] for match in letters}) > 1 == len({match[1] for match in letters}):
            return list(dict.fromkeys(match[0] for match in letters))
        named: dict[str, dict[str, str]] = {}
        for match in (match for cell in row if (match := _OF_AXIS.search(cell)) is not None):
            named.setdefault(match[1].lower(), {})[match[2].lower()] = match[0].strip()
        several = next((told for told in named.values() if len(told) > 1), None)
        if several is not None:
            return list(several.values())
    return []


def is_index(head: str) -> bool:
    """Return whether a column counts its rows: ``i``, ``i-th``, ``Pos No.``."""
    return _INDEX.match(head.strip()) is not None


def is_opposite(head: str) -> bool:
    """Return whether the sign of a column is the opposite of a deviation's: corrections, or nominal minus actual."""
    return bool(REVERSED.search(head)) or bool(_CORRECTION.search(head) and not is_deviation(head))


def names_target(head: str) -> bool:
    """Return whether a column holds targets; positional deviations, as ISO 230-2 calls them, are none."""
    told = _TARGET.match(head.strip()) is not None and not is_deviation(head)
    return told and not is_index(head) and "radius" not in head.lower()


def _targets(names: Sequence[str]) -> list[int]:
    """Return the columns that may hold the targets, the surest first."""
    # Beside neg, pos is a direction.
    there = {name.lower() for name in names}
    ways = {name for name in names if (low := name.lower()).startswith("pos") and f"neg{low[3:]}" in there}
    targets = [i for i, name in enumerate(names) if names_target(name) and name not in ways]
    return sorted(targets, key=lambda i: (_COUNTED.fullmatch(names[i]) is not None, not SURELY_TARGET.match(names[i])))


def other_targets(heads: Sequence[str], target: int) -> list[int]:
    """Return the further columns of targets in the same unit: those of another direction, as a rule."""
    sure = [i for i, head in enumerate(heads) if SURELY_TARGET.match(head.strip()) and names_target(head)]
    sure = [i for i in sure if i != target and not _COUNTED.fullmatch(heads[i].strip())]
    return [i for i in sure if not is_deviation(heads[i]) and unit_of(heads[i]) == unit_of(heads[target])]


@dataclass(frozen=True)
class Long:
    """Columns of a table with one reading a row; without ``cycle`` they are counted, without ``way`` their order tells it."""

    target: int
    way: int | None
    cycle: int | None
    value: int


def long_of(heads: Sequence[str]) -> Long | None:
    """Return which column is which in a table of one row a reading; None when it is none."""
    names = [head.strip() for head in heads]
    # That is dtwin's own table.
    if {"position_mm", "error_um", "t_s"} <= set(names):
        return None

    def first(pattern: re.Pattern[str], *taken: int | None) -> int | None:
        return next((i for i, name in enumerate(names) if i not in taken and pattern.search(name)), None)

    way = first(_WAY)
    cycle = first(CYCLE, way)
    deviations = [i for i, name in enumerate(names) if i not in (way, cycle) and is_deviation(name) and _is_read(name)]
    bare = [i for i in deviations if _BARE.fullmatch(IN_BRACKETS.sub("", names[i]).strip())]
    deviation = next(iter([*bare, *deviations]), None)
    value = deviation if deviation is not None else first(_ACTUAL, way, cycle)
    indices = [i for i, name in enumerate(names) if is_index(name)]
    target = next((i for i in _targets(names) if i not in (way, cycle, value)), None)
    if value is None and target is not None:
        # Two columns of places: the one that says so is the target.
        target = first(SURELY_TARGET, way, cycle)
        value = None if target is None else first(_TARGET, way, cycle, target, *indices)
    if way is None:
        target, value = _plain(names)
    if target is None or value is None:
        return None
    # One of several columns of readings is no table of one reading a row.
    others = [name for i, name in enumerate(names) if i not in (target, way, cycle, value) and name != names[value]]
    if _NUMBER.search(names[value]) and _stem(names[value]) in map(_stem, others):
        return None
    return Long(target, way, cycle, value)


def deviations_of(heads: Sequence[str], long: Long) -> list[int]:
    """Return the further columns that may hold the deviations as well; none beside one that is called nothing else."""
    names = [IN_BRACKETS.sub("", head).strip() for head in heads]
    taken = (long.target, long.way, long.cycle, long.value)
    if _BARE.fullmatch(names[long.value]):
        return []
    return [i for i, name in enumerate(names) if i not in taken and is_deviation(name) and _is_read(name)]


def _plain(names: Sequence[str]) -> tuple[int | None, int | None]:
    """Return the columns of targets and readings of a table that names no direction, where nothing else can be meant; else None."""
    targets, read = _without_direction(names)
    if any(
        way and is_unit(told_unit(name, "")) and _is_read(name)
        for name, way in zip(names, _ways_of(names), strict=True)
    ):
        return None, None
    deviations = [i for i in read if is_deviation(names[i])]
    read = deviations if len(deviations) == 1 else read
    left = [_stem(name) for i, name in enumerate(names) if i not in (*targets, *read) and _NUMBER.search(name)]
    if any(often > 1 for often in Counter(left).values()):
        # Cycles whose heads are not known.
        return None, None
    return (targets[0], read[0]) if len(targets) == len(read) == 1 else (None, None)


def _without_direction(names: Sequence[str]) -> tuple[list[int], list[int]]:
    """Return the columns of targets and of readings, in units of length or angle, by heads that name no direction."""
    told = [name.strip() for name in names]
    ways = _ways_of(told)
    there = [i for i, name in enumerate(told) if is_unit(told_unit(name, "") or "mm") and ways[i] is None]
    targets = [i for i in there if SURELY_TARGET.match(told[i]) and names_target(told[i])]
    read = [
        i
        for i in there
        if i not in targets
        and (SURELY_READ.match(told[i]) or is_deviation(told[i]) or CYCLE.match(told[i]) or _RUN.match(told[i]))
        and _is_read(told[i])
        and not (CYCLE.match(told[i]) and not told_unit(told[i], ""))
    ]
    return targets, read


def names_no_direction(rows: Sequence[Sequence[str]]) -> str:
    """Return the head of a column of readings in a table of one row a target that does not tell their directions; else nothing."""
    for row in rows[:MOST_TITLES]:
        targets, read = _without_direction(row)
        senses = [cell.strip() for cell in row if names_sense(cell)]
        if len(targets) == 1 < len(senses):
            return senses[0]
        alike = Counter(_NUMBER.sub("", row[i]) for i in read)
        if len(targets) == 1 and len(alike) in (1, 2) and len(set(alike.values())) == 1 < alike.total() / len(alike):
            return row[read[0]].strip()
    return ""


def by_way_of(heads: Sequence[str]) -> tuple[int, int, tuple[tuple[int, int], ...]] | None:
    """Return the columns of targets, of directions, and of readings with their cycles, in a table of one row a target and direction."""
    names = [with_shares(head.strip()) for head in heads]
    way = next((i for i, name in enumerate(names) if _WAY.match(name)), None)
    stems = Counter(map(_stem, names))
    # Of several that are counted each is a cycle.
    places = [i for i in _targets(names) if stems[_stem(names[i])] == 1]
    if way is None or not places:
        return None
    target = places[0]
    counted = [
        (i, int(number[1]), _stem(name))
        for i, name in enumerate(names)
        if i not in (way, target) and not SURELY_TARGET.match(name) and not SUMS_UP.search(name)
        if (number := _NUMBER.search(name))
    ]
    # Readings of several cycles are called alike.
    alike = [stem for stem, often in Counter(stem for _, _, stem in counted).items() if often > 1]
    return (target, way, tuple((i, n) for i, n, stem in counted if stem == alike[0])) if len(alike) == 1 else None


def _stem(head: str) -> str:
    """Return a head without its first number."""
    return _NUMBER.sub("", head, count=1)


def deviation_of(head: str, factor: float, value: float, target: float, scale: Scale) -> tuple[float, bool]:
    """Return the deviation, and whether the column holds positions; ``factor``: how many of the unit of targets its own is."""
    by_position = not is_deviation(head) and factor >= _OF_POSITIONS
    return (value - target if by_position else value) * scale.per, by_position


def _is_read(head: str) -> bool:
    """Return whether a column may hold readings: neither what sums them up, nor limits, uncertainties or what a control follows by."""
    words = head.replace("_", " ")
    return not SUMS_UP.search(words) and not _NOT_READ.search(words)


def is_deviation(head: str) -> bool:
    """Return whether a head says that its column holds deviations."""
    return _DEVIATION.search(head) is not None


def unit_of(head: str) -> str:
    """Return the unit of length, or of angle, that a head tells, in brackets or at its end; empty when it tells none."""
    head = with_shares(head)
    match = UNIT_INSIDE.search(head) or _UNIT.search(head)
    return match[1] if match else ""


def is_unit(cell: str) -> bool:
    """Return whether a cell holds a unit of length, or of angle, and nothing else."""
    return plain_unit(cell) in LENGTHS_MM or plain_unit(cell) in ANGLES_DEG


def is_row_of_units(row: Sequence[str], target: int) -> bool:
    """Return whether a row below the heads holds units; beside that of the targets there may be some of times and temperatures."""
    of_target = row[target] if target < len(row) else ""
    return not any(map(is_number, row)) and (is_unit(of_target) or all(not c.strip() or is_unit(c) for c in row))


def told_unit(head: str, unit: str) -> str:
    """Return the unit of a column as ``unit``, the row below, or the head tells it, known here or not; empty without one."""
    told = unit.strip() or unit_of(unicodedata.normalize("NFKC", head))
    inside = (text for text in IN_BRACKETS.findall(head) if not _COUNTS.fullmatch(text) and way_of(text) is None)
    words = (_TARGET, _ACTUAL, _DEVIATION, CYCLE)
    return told or next((text for text in inside if not any(word.search(text) for word in words)), "")


def is_length(head: str, unit: str = "") -> bool:
    """Return whether a column is in a unit of length, as the row below, or its head, tells."""
    return plain_unit(told_unit(head, unit)) in LENGTHS_MM or plain_unit(head) in LENGTHS_MM


def plain_unit(cell: str) -> str:
    """Return a unit as tables of units have it."""
    return with_shares(unicodedata.normalize("NFKC", cell).strip().strip("[]()").strip()).lower()
