"""A foreign table becomes a campaign folder: what it is understood as is told first, and remembered for the next file.

Columns are known by their heads (English and German) and units, which stand in the head, as ``[mm]`` or ``_mm``, or in a row
below it. A number without a unit is left out until it is told what it is: a wrong guess would be found only in the machine.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
import re
import tempfile
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tomli_w

from dtwin.acquire._lone_table import open_table, safe_name
from dtwin.acquire.spreadsheet import table_bytes
from dtwin.acquire.table_dialect import decoded, encoding_of, mark_of, rows_of
from dtwin.acquire.xmlsafe import read_bounded
from dtwin.atomic import make_folder, write_text, write_toml
from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.kinds.registry import kind_named, kinds
from dtwin.units import UNITS

_MAX_BYTES = 64 * 1024**2
_MOST_COLUMNS = 512
_MOST_PREAMBLE = 200
# The direction is that in which the angle runs, file by file.
_REMEMBERED = ("machine", "plane", "radius_mm", "feed_mm_min", "axis")
_MARKS = {";": "semicolons", "\t": "tabs", ",": "commas"}
# What a foreign unit is here, and how many of it.
_UNITS: Mapping[str, tuple[str, float]] = {
    **dict.fromkeys(("um", "µm", "μm", "micron"), ("um", 1.0)),
    "nm": ("um", 1e-3),
    "mm": ("mm", 1.0),
    "m": ("mm", 1000.0),
    **dict.fromkeys(("in", "inch"), ("mm", 25.4)),
    **dict.fromkeys(("s", "sec", "sek"), ("s", 1.0)),
    "ms": ("s", 1e-3),
    "min": ("s", 60.0),
    **dict.fromkeys(("°", "deg", "grad"), ("deg", 1.0)),
    "rad": ("deg", 180.0 / math.pi),
    **dict.fromkeys(("°c", "c", "degc"), ("c", 1.0)),
    "mm/min": ("mm_min", 1.0),
    "mm/s": ("mm_s", 1.0),
    "hz": ("hz", 1.0),
    "g": ("g", 1.0),
    "v": ("v", 1.0),
    "a": ("a", 1.0),
}
_BETWEEN = {("mm", "um"): 1000.0, ("um", "mm"): 1e-3, ("rad", "deg"): 180.0 / math.pi, ("ms", "s"): 1e-3}
_HEADS = (
    (re.compile(r"^(t|time|zeit)$", re.I), "t", "s"),
    (re.compile(r"^(path )?(angle|winkel|phi)$", re.I), "angle", "deg"),
    (re.compile(r"^(radial )?(deviation|abweichung)$", re.I), "deviation", "um"),
    (re.compile(r"^(error|fehler|positionsfehler)$", re.I), "error", "um"),
    (re.compile(r"^(position|pos|weg|soll|sollposition|target|nominal)$", re.I), "position", "mm"),
)
_TIME, _ANGLE = "t_s", "angle_deg"
_WITH_UNIT = re.compile(r"^(.*?)\s*[\[(]\s*([^\])]*?)\s*[\])]\s*$")


@dataclass(frozen=True)
class Column:
    """A column of the file: ``head`` and ``unit`` as they stand there, ``name`` here, and the factor to it; or why not."""

    head: str
    unit: str
    name: str
    factor: float = 1.0
    why_not: str = ""


@dataclass(frozen=True)
class Understood:
    """What a file is taken for; nothing is written yet.

    Attributes
    ----------
    columns : tuple of Column
        Empty where the kind reads such a table by rules of its own.
    missing : tuple of str
        Conditions that must be told before it can be written.
    runs : tuple of (str, int)
        Name and rows of each run; empty while conditions are missing.
    remembered : bool
        Whether answers of an earlier file with this header were used.
    text : str
        The table in the house's form.
    """

    path: Path
    encoding: str
    mark: str
    skipped: int
    columns: tuple[Column, ...]
    kind: str
    told: Mapping[str, Any]
    missing: tuple[str, ...]
    runs: tuple[tuple[str, int], ...]
    remembered: bool
    text: str
    header: tuple[str, ...]
    answers: Mapping[str, str]

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return {
            "file": str(self.path),
            "encoding": self.encoding,
            "parted_by": _MARKS[self.mark],
            "lines_skipped": self.skipped,
            "columns": [vars(column) for column in self.columns],
            "kind": self.kind,
            "conditions": dict(self.told),
            "missing": list(self.missing),
            "runs": dict(self.runs),
            "remembered": self.remembered,
        }


def understand(path: Path, home: Home, told: Mapping[str, Any], answers: Mapping[str, str]) -> Understood:
    """Return what a table is taken for.

    Parameters
    ----------
    told : mapping
        Conditions, as :func:`open_table` takes them; they go before those remembered.
    answers : mapping of str to str
        The house's column for a head of the file: ``{"Weg": "position_mm"}``; an empty one leaves it out.

    Raises
    ------
    InputError
        When it is no table, or its columns are those of no kind of test.
    """
    data = table_bytes(path, _MAX_BYTES)
    text = decoded(data)
    rows = rows_of(text)
    begin = _header(rows, path)
    heads = tuple(cell.strip() for cell in rows[begin])
    units = rows[begin + 1] if begin + 1 < len(rows) and _all_units(rows[begin + 1]) else None
    body = rows[begin + (1 if units is None else 2) :]
    stored = _recipe(home, heads)
    answers = {**stored.get("columns", {}), **answers}
    unknown = sorted(set(answers) - set(heads))
    if unknown:
        raise InputError(
            "the file has no such column",
            code="import.column",
            where=str(path),
            got=", ".join(unknown)[:80],
            allowed=", ".join(heads)[:200],
        )
    given = {name: value for name, value in told.items() if value is not None}
    told = {**{k: v for k, v in stored.get("told", {}).items() if k in _REMEMBERED}, **given}
    plain = _as_csv(rows[begin:])
    with tempfile.TemporaryDirectory() as scratch:
        lone = Path(scratch) / f"{safe_name(path.stem)}.csv"
        write_text(lone, plain, "a table")
        columns: tuple[Column, ...] = ()
        if answers or not any(kind.takes_alone(lone) for kind in kinds()):
            columns = _columns(heads, units, answers)
            plain = _converted(columns, body, _seconds_per_deg(columns, told, path))
            write_text(lone, plain, "a table")
        kind = _kind(lone, plain.partition("\n")[0].split(","), columns, path)
        missing = tuple(name for name in kind_named(kind).stated or () if name not in told)
        runs: tuple[tuple[str, int], ...] = ()
        if not missing:
            opened = open_table(lone, told)
            runs = tuple((run.meta.run_id, run.n_samples) for run in opened.read(opened.entries[0])[0])
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    encoding, mark = encoding_of(data), mark_of(lines)
    return Understood(
        path, encoding, mark, begin, columns, kind, told, missing, runs, bool(stored), plain, heads, answers
    )


def write_folder(found: Understood, folder: Path, home: Home) -> Path:
    """Write a campaign folder and remember the answers; return its ``campaign.toml``, which is written last.

    Raises
    ------
    InputError
        When the folder is there already, or conditions are missing.
    """
    if folder.exists():
        raise InputError(
            "the folder is there already", code="import.exists", where=str(folder), hint="--out with another name"
        )
    with tempfile.TemporaryDirectory() as scratch:
        lone = Path(scratch) / f"{safe_name(found.path.stem)}.csv"
        write_text(lone, found.text, "a table")
        opened = open_table(lone, found.told)
    campaign, (entry,) = opened.campaign, opened.entries
    # A comment: files of one campaign may differ in it.
    digest = hashlib.sha256(found.path.read_bytes()).hexdigest()
    source = f"# dtwin import {json.dumps(found.path.name)}, sha256 {digest}\n"
    kept = {name: found.told[name] for name in _REMEMBERED if name in found.told}
    recipe = {"header": list(found.header), "columns": dict(found.answers), "told": kept}
    place = _recipe_path(home, found.header)
    try:
        make_folder(home.made().root / place.parent.name)
        make_folder(folder)
    except OSError as error:
        raise InputError(
            "a folder cannot be made", code="import.folder", where=str(error.filename), got=str(error.strerror)
        ) from error
    write_toml(place, recipe, "the recipe")
    write_text(folder / lone.name, found.text, "the table")
    document = {
        "campaign": {"name": campaign.name, "machine": campaign.machine, "kind": found.kind},
        "run": [dict(entry.stated)],
    }
    return write_text(folder / "campaign.toml", source + tomli_w.dumps(document), "the campaign")


def _header(rows: Sequence[Sequence[str]], path: Path) -> int:
    """Return which row holds the heads: the first before a row of as many cells with numbers, or with units."""
    for n, row in enumerate(rows[:_MOST_PREAMBLE]):
        after = next((r for r in rows[n + 1 : n + 3] if not _all_units(r)), [])
        named = sum(bool(cell.strip()) and not _is_number(cell) for cell in row)
        if 2 <= len(row) <= _MOST_COLUMNS and 2 * named > len(row) and len(after) == len(row):
            numbers = sum(_is_number(cell) for cell in after)
            if numbers >= 2 and not _all_units(row):
                return n
    raise InputError(
        "no table is found in the file",
        code="import.table",
        where=str(path),
        got=f"{len(rows)} lines",
        allowed=f"a row of heads above rows of numbers, within {_MOST_PREAMBLE} lines and {_MOST_COLUMNS} columns",
        hint="dtwin check FILE reads the forms of instruments",
    )


def _columns(heads: Sequence[str], units: Sequence[str] | None, answers: Mapping[str, str]) -> tuple[Column, ...]:
    found: list[Column] = []
    for n, head in enumerate(heads):
        column = _column(head, units[n].strip() if units is not None and n < len(units) else "", answers.get(head))
        if column.name and any(other.name == column.name for other in found):
            column = Column(head, column.unit, "", why_not=f"{column.name} is there already")
        found.append(column)
    return tuple(found)


def _column(head: str, unit_below: str, answer: str | None) -> Column:
    match = _WITH_UNIT.match(head)
    base, unit = (match[1], match[2]) if match else (head, unit_below.strip("[]() "))
    if unit:
        here, factor = _UNITS.get(unit.lower(), ("", 1.0))
    else:
        unit = here = _ending(head)
        base, factor = head.removesuffix(f"_{here}"), 1.0
    if answer is not None:
        if not answer:
            return Column(head, unit, "", why_not="you left it out")
        wanted = _ending(answer)
        return _scaled(head, unit, answer, here or wanted, wanted, factor)
    if not here:
        return Column(head, unit, "", why_not=f"its unit {unit} is not known" if unit else "no unit is told")
    for pattern, stem, wanted in _HEADS:
        if pattern.match(base.replace("_", " ").strip()):
            return _scaled(head, unit, f"{stem}_{wanted}", here, wanted, factor)
    stem = re.sub(r"\W+", "_", base.strip().lower()).strip("_") or "column"
    return Column(head, unit, f"{stem}_{here}", factor)


def _ending(name: str) -> str:
    """Return the unit that a column's name ends with, as it stands there; empty without one: a number counts columns."""
    return next((ending for ending in UNITS if ending != "1" and name.endswith(f"_{ending}")), "")


def _scaled(head: str, unit: str, name: str, here: str, wanted: str, factor: float) -> Column:
    if here == wanted:
        return Column(head, unit, name, factor)
    if (here, wanted) in _BETWEEN:
        return Column(head, unit, name, factor * _BETWEEN[here, wanted])
    return Column(head, unit, "", why_not=f"{unit or 'nothing'} cannot be {name}")


def _seconds_per_deg(columns: Sequence[Column], told: Mapping[str, Any], path: Path) -> float | None:
    """Return the time that a degree took, where a table of a circle tells none: at the programmed feed."""
    names = {c.name for c in columns}
    if not any(kind.goes_round and set(kind.columns) - names == {_TIME} for kind in kinds()):
        return None
    radius_mm, feed_mm_min = told.get("radius_mm"), told.get("feed_mm_min")
    if not radius_mm or not feed_mm_min:
        raise InputError(
            "the table of a circle tells no time",
            code="import.time",
            where=str(path),
            got=", ".join(sorted(names - {""})),
            hint="--radius and --feed tell how long a degree takes; a column of time in s is better",
        )
    return float(math.radians(1.0) * radius_mm / (feed_mm_min / 60.0))


def _kind(lone: Path, names: Sequence[str], columns: Sequence[Column], path: Path) -> str:
    for kind in kinds():
        if kind.takes_alone(lone) or (columns and set(names) >= set(kind.columns)):
            return kind.name
    raise InputError(
        "the columns are those of no kind of test",
        code="import.kind",
        where=str(path),
        got="; ".join(f"{c.head}: {c.name or c.why_not}" for c in columns)[:300],
        allowed="; ".join(f"{kind.name}: {', '.join(kind.columns)}" for kind in kinds()),
        hint='--column "HEAD=position_mm" says what a column is, with the unit that the file has',
    )


def _converted(columns: Sequence[Column], body: Sequence[Sequence[str]], seconds_per_deg: float | None) -> str:
    kept = [(n, column) for n, column in enumerate(columns) if column.name]
    table = [[column.name for _, column in kept]]
    for row in body:
        cells = [(row[n].strip() if n < len(row) else "", column.factor) for n, column in kept]
        table.append([f"{float(cell) * factor:.12g}" if _is_number(cell) else "" for cell, factor in cells])
    return _as_csv(table if seconds_per_deg is None else _with_time(table, seconds_per_deg))


def _with_time(table: Sequence[Sequence[str]], seconds_per_deg: float) -> list[list[str]]:
    """Return a table of a circle with a column of time at the programmed feed."""
    at = table[0].index(_ANGLE)
    begun = next((float(row[at]) for row in table[1:] if row[at]), 0.0)
    times = [f"{abs(float(row[at]) - begun) * seconds_per_deg:.12g}" if row[at] else "" for row in table[1:]]
    return [[first, *row] for first, row in zip([_TIME, *times], table, strict=True)]


def _as_csv(rows: Sequence[Sequence[str]]) -> str:
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows(rows)
    return out.getvalue()


def _all_units(row: Sequence[str]) -> bool:
    """Tell whether a row holds units, and nothing else but empty cells."""
    told = [cell.strip().strip("[]() ").lower() for cell in row if cell.strip()]
    return bool(told) and all(cell in _UNITS for cell in told)


def _is_number(cell: str) -> bool:
    try:
        return math.isfinite(float(cell))
    except ValueError:
        return False


def _recipe_path(home: Home, heads: Sequence[str]) -> Path:
    key = hashlib.sha256(json.dumps(list(heads)).encode()).hexdigest()[:16]
    return home.root / "recipes" / f"{key}.toml"


def _recipe(home: Home, heads: Sequence[str]) -> dict[str, Any]:
    """Return what was answered for a file with this header; empty without one, or when it cannot be read."""
    place = _recipe_path(home, heads)
    if not place.is_file():
        return {}
    try:
        found = tomllib.loads(read_bounded(place).decode("utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(
            "the recipe for this header cannot be read", code="import.recipe", where=str(place), hint="delete the file"
        ) from error
    columns, told = found.get("columns", {}), found.get("told", {})
    return {"columns": columns, "told": told} if isinstance(columns, dict) and isinstance(told, dict) else {}
