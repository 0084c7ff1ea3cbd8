"""Columns of a foreign table: which row names them, what each is here, and by which factor."""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from dtwin.acquire.xmlsafe import number_or_none
from dtwin.errors import InputError
from dtwin.units import G_MM_S2, LENGTHS_MM, NEWTON_METRE, TIMES_S, UM_PER_MM, UNITS, with_shares

_MOST_COLUMNS = 512
_MOST_PREAMBLE = 200
_Row = TypeVar("_Row", bound=Sequence[str])
_MOST_GAPS = 20
# Lengths of smaller units become µm.
_LEAST_MM = 0.01
_FAHRENHEIT = ("°f", "f°", "degf", "fahrenheit", "f")
_FREEZING_F = 32.0
_DIFFERENCE = re.compile(r"rise|delta|diff|[Δδ]", re.I)
# What a foreign unit is here, and how many of it.
_UNITS: Mapping[str, tuple[str, float]] = {
    **{name: ("um", UM_PER_MM * mm) if mm < _LEAST_MM else ("mm", mm) for name, mm in LENGTHS_MM.items()},
    **{name: ("s", seconds) for name, seconds in TIMES_S.items()},
    **dict.fromkeys(("°", "deg", "degree", "degrees", "度", "gradi", "grados", "degrés"), ("deg", 1.0)),
    **dict.fromkeys(("gon", "gons", "gradian", "gradians"), ("deg", 0.9)),
    "rad": ("deg", 180.0 / math.pi),
    **dict.fromkeys(("°c", "c", "degc", "c°", "celsius", "gradc", "gradcelsius"), ("c", 1.0)),
    **dict.fromkeys(_FAHRENHEIT, ("c", 1.0 / 1.8)),
    "mm/min": ("mm_min", 1.0),
    "mm/s": ("mm_s", 1.0),
    **dict.fromkeys(("m/s2", "m/s^2"), ("g", 1000.0 / G_MM_S2)),
    "mm/s2": ("mm_s2", 1.0),
    **dict.fromkeys(("rpm", "1/min", "u/min", "min-1"), ("rpm", 1.0)),
    **dict.fromkeys(("%", "%rh", "%rf"), ("pct", 1.0)),
    **dict.fromkeys(("um/m", "μm/m"), ("um_per_m", 1.0)),
    NEWTON_METRE: ("nm", 1.0),
    **{name: (name, 1.0) for name in ("kpa", "hz", "g", "v", "a")},
    **dict.fromkeys(("hpa", "mbar"), ("kpa", 0.1)),
    "mg": ("g", 1e-3),
}
_NOT_READ = frozenset(
    [
        "k",
        "n",
        "kn",
        "w",
        "kw",
        "bar",
        "mmhg",
        "l/min",
        "mv",
        "ma",
        "khz",
        "mrad",
        "μrad",
        "urad",
        "arcsec",
        "arcmin",
        "″",
    ]
)
"""Units of columns that are left out."""
TURNED = re.compile(r"\s*([-\u2212\u2013]\s*[^\W\d]|\|)|.*±")
"""Of a head such as ``-deviation``, ``|error|`` or ``error ±``."""
_TIME_ALONE = ("seconds", "minutes", "hours", "days", "sekunden", "minuten", "stunden", "tage")
"""Heads that are nothing but a unit of time; of one minute it may be that of the hour."""
_GRAD = "grad"
_VALUE = re.compile(r"\d[.,:/-]?\d")
_GRAD_WHY_NOT = "grad is a degree in German and 1/400 of a turn elsewhere: write ° or gon"
_BETWEEN = {("mm", "um"): 1000.0, ("um", "mm"): 1e-3, ("rad", "deg"): 180.0 / math.pi, ("ms", "s"): 1e-3}
DEVIATION = re.compile(
    r"^((radi(al|us)(e|er)?[ -]?|kreis(form)?)?(deviation|dev\.?|abweichung)|radi(al|us)(er)?[ -]?(error|fehler)|[Δδd]r|delta r)$",
    re.I,
)
"""Head of a deviation from a circle whose direction is not told."""
_HEADS = (
    (re.compile(r"^(t|time|zeit|elapsed( time)?|time elapsed|messzeit|time ?stamp|epoch|unix ?time)$", re.I), "t", "s"),
    (re.compile(r"^(path )?(angle|winkel|phi|[φθ])$", re.I), "angle", "deg"),
    (DEVIATION, "deviation", "um"),
    (re.compile(r"^(error|fehler|positionsfehler)$", re.I), "error", "um"),
    (re.compile(r"^(position|pos|weg|soll|sollposition|target|nominal)$", re.I), "position", "mm"),
)
_OF_WHICH = re.compile(
    r"(machine|maschine|macchina|m[aá]quina|robot|roboter|tool|werkzeug)[\s_]*(no|nr|name|id|number|nummer)?\.?|s/?n|serial( (no|number))?\.?|seriennummer",
    re.I,
)
"""Head of a column that says of which machine, or with which tool, a row is."""
PROBES = r"probe|sensor|capteur|palpeur|sonde|(mess)?taster|messuhr|gauge|lvdt|kanal|channel|ch(?=[ _.]?\d)"
"""Words of a head that name what reads a displacement."""
_ENGLISH = tuple(
    (english, re.compile(words, re.I))
    for english, words in (
        ("counterclockwise", "(?:反時計|左)[回周]り|逆时针"),
        ("clockwise", "(?:時計|右)[回周]り|顺时针"),
        ("time", r"(?:測定|計測)?(?:時刻|日時)|(?:経過|測定|計測)?時間|时间|\b(?:temps|tempo|tiempo)\b"),
        ("room temperature", "室温|気温"),
        ("temperature", "温度"),
        ("displacement", r"変位量?|位移量?|\b(?:déplacement|spostamento|desplazamiento)\b"),
        ("target", r"(?:指令|目標|目标)[値值位置]*|\b(?:cible|consigne)\b"),
        ("measured", r"(?:測定|計測|実測|测量|实测)[値值位置]*|\bmesurée?\b"),
        ("radial", "半径方向|径向"),
        ("axial", "軸方向|轴向"),
        ("angle", r"(?:回転)?角度|\b(?:angolo|ángulo)\b"),
        ("radius", r"半径|\b(?:rayon|raggio|radio)\b"),
        ("deviation", r"偏差|\b(?:écart|scostamento|desviación)\b"),
        ("error", r"誤差|误差|\b(?:erreur|errore)\b"),
        ("speed", "回転(?:速度|数)|转速|轉速"),
        ("spindle", "主軸|主轴"),
    )
)
"""Words of heads in other languages."""
_WITH_UNIT = re.compile("^(.*?)\\s*[\\[(\uff08\uff3b]\\s*([^\\])\uff09\uff3d]*?)\\s*[\\])\uff09\uff3d]\\s*$")
# Weg in µm, Weg / µm, Weg µm; a lone letter may be the name of a channel.
_SAID = re.compile(r"^(.+?)(?:\s+in\s+|\s*/\s*|\s+(?=(?:[µμu]m|mm|°|deg)$))((?![afgv]$)\S+)$", re.I)


@dataclass(frozen=True)
class Column:
    """A column of the file: ``head`` and ``unit`` as they stand there, ``name`` here, and the way to it; or why not.

    ``factor``, ``zero``: a value v of the file is factor (v - zero) here.
    """

    head: str
    unit: str
    name: str
    factor: float = 1.0
    zero: float = 0.0
    why_not: str = ""


def in_english(head: str) -> str:
    """Return a head with the words that are known of other languages in English, ``変位X [μm]`` as ``displacement X [μm]``, and parts of units as words."""
    head = head.strip().rstrip(":").rstrip()
    said = head
    for english, words in _ENGLISH:
        said = words.sub(f" {english} ", said)
    return with_shares(head if said == head else " ".join(said.split()))


def header_row(rows: Sequence[Sequence[str]], path: Path) -> int:
    """Return which row holds the heads: the first before a row of as many cells with numbers, or with units."""
    for n, row in enumerate(rows[:_MOST_PREAMBLE]):
        after = next((r for r in rows[n + 1 : n + _MOST_GAPS] if not all_units(r) and not _has_gaps(r)), [])
        named = sum(bool(cell.strip()) and not is_number(cell) for cell in row)
        # Spreadsheets leave blank columns at the end.
        width = max((i for i, cell in enumerate(row, start=1) if cell.strip()), default=0)
        if 2 <= len(row) <= _MOST_COLUMNS and 2 * named > width and named >= 2 and len(after) == len(row):
            numbers = sum(is_number(cell) for cell in after)
            # Of a logger of one channel a time and a reading.
            timed = numbers == 1 and _STAMPED.match(after[0].strip()) is not None
            if (numbers >= 2 or timed) and not all_units(row):
                return n
    raise InputError(
        "no table is found in the file",
        code="import.table",
        where=str(path),
        got="1 line" if len(rows) == 1 else f"{len(rows)} lines",
        allowed=f"a row of heads above rows of numbers, within {_MOST_PREAMBLE} lines and {_MOST_COLUMNS} columns",
        hint="write heads with units above numbers that have none, such as time [s], angle [deg]; dtwin check FILE reads the forms of instruments",
    )


def joined_heads(rows: Sequence[Sequence[str]], path: Path) -> list[Sequence[str]]:
    """Return the rows of a table with one row of heads where they stand in two, as under merged cells; other rows as they are.

    A head that is empty, or a unit, and has a word above it says so, or heads that are alike; a merged cell's word goes on until the next one.
    """
    try:
        begin = header_row(rows, path)
    except InputError:
        return list(rows)
    above, heads = rows[begin - 1] if begin else [], rows[begin]
    said = [with_shares(cell.strip()) for cell in above]
    merged = len(above) == len(heads) and sum(map(bool, said)) > 1 and not any(map(_VALUE.search, said))
    told = [head.strip() for head in heads if head.strip()]
    empty = merged and any(word and (not head or all_units([head])) for word, head in zip(said, heads, strict=True))
    if not merged or not (empty or len(set(told)) < len(told)):
        return list(rows)
    joined, last = [], ""
    for word, head in zip(said, heads, strict=True):
        last = word or last
        unit = _WITH_UNIT.match(last)
        # The unit of the merged cell is that of each head below it.
        joined.append(f"{unit[1]} {head} [{unit[2]}]" if unit and head.strip() else f"{last} {head.strip()}".strip())
    return [*rows[: begin - 1], joined, *rows[begin + 1 :]]


def require_one_table(heads: Sequence[str], body: Sequence[Sequence[str]], path: Path, *, once: bool = False) -> None:
    """Refuse a file in which other heads stand below the first table, or rows are of several machines: they would be taken for those of one.

    ``once``: the same heads are refused, too, where titles tell the tables apart, which are not read.
    """
    told = [head.strip() for head in heads]
    rows = [[cell.strip() for cell in row] for row in body]
    other = next((row for row in rows if row and row[0] and row[0] == told[0] and (once or row != told)), None)
    if other is not None:
        raise InputError(
            "a second table stands below the first",
            code="table.second",
            where=str(path),
            got=", ".join(other)[:120],
            allowed="one table",
            hint="a file for each, or columns beside each other",
        )
    require_one_of(_OF_WHICH, told, rows, path)


def require_one_of(
    which: re.Pattern[str], heads: Sequence[str], body: Sequence[Sequence[str]], path: Path, *, repeated: bool = False
) -> None:
    """Refuse rows of several machines, or parts or places of one, as a column whose head is one of ``which`` tells.

    ``repeated``: numbers are places, too, where each stands there more than once on average.
    """
    for n in (n for n, head in enumerate(heads) if which.fullmatch(head.strip())):
        names = list(dict.fromkeys(row[n].strip() for row in body if n < len(row) and row[n].strip()))
        # Decimals, and many numbers, are readings.
        read = any("." in name and is_number(name) for name in names) or (
            len(names) > 20 and all(map(is_number, names))
        )
        read = 2 * len(names) > len(body) if repeated else read
        if len(names) > 1 and not read:
            raise InputError(
                "the rows are of several machines, tools, places or conditions",
                code="table.several",
                where=f"{path} {heads[n].strip()}",
                got=", ".join(names)[:80],
                allowed="one",
                hint="a file for each",
            )


def require_told_apart(columns: Sequence[Column], body: Sequence[Sequence[str]], path: Path) -> None:
    """Refuse columns with one head and different readings, of which one would be left out: a time that is written twice is none."""
    cells = [[row[n].strip() if n < len(row) else "" for row in body] for n in range(len(columns))]
    for n, column in enumerate(columns):
        first = next(i for i, other in enumerate(columns) if other.head == column.head)
        if columns[first].name and cells[first] != cells[n]:
            raise InputError(
                "several columns have one head and different readings",
                code="import.twice",
                where=str(path),
                got=column.head[:80],
                allowed="a head for each; of a circle angle [deg], ccw [µm], cw [µm]",
                hint="a file for each, or other heads; of runs beside each other, one below the other",
            )


def converted(columns: Sequence[Column], body: Sequence[Sequence[str]]) -> list[list[str]]:
    """Return a table of the columns that have a name here, with that name and in its unit; empty where a cell is no number."""
    kept = [(n, column) for n, column in enumerate(columns) if column.name]

    def cells(n: int, column: Column) -> Iterator[str]:
        for row in body:
            value = number_or_none(row[n]) if n < len(row) else None
            yield "" if value is None else f"{column.factor * (value - column.zero):.12g}"

    return [[column.name for _, column in kept], *map(list, zip(*(cells(*one) for one in kept), strict=True))]


def _has_gaps(row: Sequence[str]) -> bool:
    """Tell whether a row holds one number and empty cells, as where an instrument read nothing."""
    told = [cell for cell in row if cell.strip()]
    return len(told) == 1 and is_number(told[0])


def columns_of(heads: Sequence[str], units: Sequence[str] | None, answers: Mapping[str, str]) -> tuple[Column, ...]:
    """Return what each column is; ``answers``: names here by head, where the user told them."""
    columns: list[Column] = []
    for n, head in enumerate(heads):
        column = _column(head, units[n].strip() if units is not None and n < len(units) else "", answers.get(head))
        if column.name and any(other.name == column.name for other in columns):
            column = Column(head, column.unit, "", why_not=f"{column.name} is there already")
        columns.append(column)
    return tuple(columns)


def _column(head: str, unit_below: str, answer: str | None) -> Column:
    said = in_english(head)
    match = _WITH_UNIT.match(said) or _SAID.match(said)
    if match and match.re is _SAID and _plain(match[2]) not in (*_UNITS, _GRAD):
        match = None
    if answer is None and not unit_below and said.strip().lower() in _TIME_ALONE:
        return Column(head, said, "t_s", TIMES_S[said.strip().lower()])
    base, unit = (match[1], match[2]) if match else (said, unit_below.strip("[]() "))
    plain = _plain(unit)
    if plain == _GRAD and "winkel" not in base.lower():
        return Column(head, unit, "", why_not=_GRAD_WHY_NOT)
    if unit:
        here, factor = _UNITS.get(plain if plain != _GRAD else "deg", ("", 1.0))
    else:
        unit = here = _ending(said)
        base, factor = said.removesuffix(f"_{here}"), 1.0
        before, mark, last = said.rpartition("_")
        # Behind an underline f is a name, as of what is in front.
        if not here and mark and last.lower() in _UNITS and last.lower() != "f":
            base, unit, (here, factor) = before, last, _UNITS[last.lower()]
    if answer is not None:
        if not answer:
            return Column(head, unit, "", why_not="you left it out")
        name = _of_the_house(answer)
        return _scaled(head, unit, name, here or _ending(answer), _ending(name), factor)
    if not here:
        return Column(head, unit, "", why_not=f"its unit {unit} is not known" if unit else "no unit is told")
    if TURNED.match(base):
        return Column(head, unit, "", why_not="its sign is turned round, or lost")
    for pattern, stem, wanted in _HEADS:
        # T in °C is a temperature.
        if pattern.match(base.replace("_", " ").strip()) and (stem, here) != ("t", "c"):
            return _scaled(head, unit, f"{stem}_{wanted}", here, wanted, factor)
    stem = re.sub(r"\W+", "_", base.strip().lower()).strip("_") or "column"
    return _scaled(head, unit, f"{stem}_{here}", here, here, factor)


def _of_the_house(answer: str) -> str:
    """Return the column of a kind of test that a name means that has another unit: ``deviation_um`` of ``deviation_mm``."""
    from dtwin.kinds.registry import kinds

    names = {name for kind in kinds() for name in kind.columns}
    unit = _ending(answer)
    meant = (answer.removesuffix(unit) + wanted for given, wanted in _BETWEEN if given == unit)
    return answer if answer in names else next((name for name in meant if name in names), answer)


def _ending(name: str) -> str:
    """Return the unit that a column's name ends with, as it stands there; empty without one: a number counts columns."""
    return next((ending for ending in UNITS if ending != "1" and name.endswith(f"_{ending}")), "")


def _scaled(head: str, unit: str, name: str, here: str, wanted: str, factor: float) -> Column:
    if here == wanted:
        # A difference of temperatures has no zero.
        has_zero = _plain(unit) in _FAHRENHEIT and not _DIFFERENCE.search(head)
        return Column(head, unit, name, factor, _FREEZING_F if has_zero else 0.0)
    if (here, wanted) in _BETWEEN:
        return Column(head, unit, name, factor * _BETWEEN[here, wanted])
    return Column(head, unit, "", why_not=f"{unit or 'nothing'} cannot be {name}")


_STAMPED = re.compile(r"\d[\d./-]*(?:[T\s]+\d+)?:\d\d")
CLOCK = re.compile(
    r"((dd|tt|mm|yyyy|jjjj|yy)[./-]?){3}t?|(((dd|tt|mm|yyyy|jjjj|yy)[./-]?){3}t?)?hh:mm(:ss)?([.,](s+|f+|0+))?"
)
"""The form of dates and times, below or behind their head: ``hh:mm:ss``."""


def below_heads(rows: list[_Row], begin: int) -> tuple[_Row | None, list[_Row]]:
    """Return the units below the heads of a table, None where there are none, and its rows; ``begin``: row of the heads."""
    units = rows[begin + 1] if begin + 1 < len(rows) and all_units(rows[begin + 1]) else None
    return units, rows[begin + (1 if units is None else 2) :]


def all_units(row: Sequence[str]) -> bool:
    """Tell whether a row holds units, forms of times beside them, and nothing else but empty cells."""
    told = [_plain(cell) for cell in row if cell.strip()]
    units = [cell for cell in told if not CLOCK.fullmatch(cell)]
    known = [cell in _UNITS or cell == _GRAD for cell in units]
    return any(known) and all(one or cell in _NOT_READ for one, cell in zip(known, units, strict=True))


def _plain(unit: str) -> str:
    """Return a unit in small letters without blanks and brackets; a sign such as ℃ as its letters."""
    return re.sub(r"\s", "", with_shares(unicodedata.normalize("NFKC", unit))).strip("[]()").lower()


def is_number(cell: str) -> bool:
    """Tell whether a cell is a finite number."""
    return number_or_none(cell) is not None
