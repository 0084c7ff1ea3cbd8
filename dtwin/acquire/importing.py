"""A foreign table becomes a campaign folder: what it is understood as is told first, and remembered for the next file.

Columns are known by their heads (English and German) and units, which stand in the head, as ``[mm]`` or ``_mm``, or in a row
below it. A number without a unit is left out until it is told what it is: a wrong guess would be found only in the machine.
"""

from __future__ import annotations

import hashlib
import json
import re
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tomli_w

from dtwin.acquire._lone_table import open_table, safe_name
from dtwin.acquire._recipes import recipe_path
from dtwin.acquire._tabular import is_parquet_of_a_kind
from dtwin.acquire.axis_titles import part_of_axis
from dtwin.acquire.foreign_columns import Column, columns_of
from dtwin.acquire.foreign_table import MAX_BYTES, as_csv, in_house_form, look, with_titled_way
from dtwin.acquire.spreadsheet import SUFFIXES as SPREADSHEETS
from dtwin.acquire.spreadsheet import table_bytes
from dtwin.acquire.table_dialect import decoded
from dtwin.atomic import make_folder, write_text, write_toml
from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.kinds.kind import Kind
from dtwin.kinds.registry import kind_named, kinds

_PLAIN = (".csv", ".tsv", ".txt", ".dat", ".log", ".parquet", *SPREADSHEETS)
_SHOWN = 4
# The direction is that in which the angle runs, file by file.
_REMEMBERED = ("machine", "plane", "radius_mm", "feed_mm_min", "axis")
_ASKED = re.compile(r"nominal|command|cmd|target|soll", re.I)
_MARKS = {";": "semicolons", "\t": "tabs", ",": "commas", " ": "blanks"}


@dataclass(frozen=True)
class Understood:
    """What a file is taken for; nothing is written yet.

    ``columns``: empty where the kind reads such a table by rules of its own.
    ``missing``: conditions that must be told before it can be written.
    ``runs``, (str, int): name and rows of each run; empty while conditions are missing.
    ``remembered``: the earlier file with this header whose answers were used; empty without one.
    ``unconfirmed``: conditions that only that file tells: they must be confirmed, for this one may have been
    measured otherwise.
    ``decimal``: ``comma`` or ``point`` where it was told.
    ``first_rows``: the first rows as they stand in the file.
    ``text``: the table in the house's form.
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
    remembered: str
    unconfirmed: tuple[str, ...]
    decimal: str
    first_rows: tuple[tuple[str, ...], ...]
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
            "remembered": bool(self.remembered),
            "remembered_of": self.remembered,
            "unconfirmed": list(self.unconfirmed),
            "decimal": self.decimal,
            "heads": list(self.header),
            "first_rows": [list(row) for row in self.first_rows],
        }


def read_as_it_is(path: Path) -> bool:
    """Return whether a file needs no import: Parquet with the house's names and numbers, and forms that are no plain table."""
    suffix = path.suffix.lower()
    if suffix == ".parquet":
        return is_parquet_of_a_kind(path)
    return suffix not in _PLAIN and any(kind.takes_alone(path) for kind in kinds())


def understand(
    path: Path, home: Home, told: Mapping[str, Any], answers: Mapping[str, str], decimal: str = ""
) -> Understood:
    """Return what a table is taken for.

    ``told``: conditions, as :func:`open_table` takes them; they go before those remembered.
    ``answers``: the house's column for a head of the file: ``{"Weg": "position_mm"}``; an empty one leaves it out.

    Raises ``InputError`` when it is no table, or its columns are those of no kind of test.
    """
    if read_as_it_is(path):
        raise InputError(
            "this file is read as it is",
            code="import.needless",
            where=str(path),
            got=path.suffix,
            hint=f"dtwin ingest {path.name} with its conditions, such as --axis X --machine NAME",
        )
    axis = str(told.get("axis") or "")
    looked = look(path, home, decimal, axis)
    if not axis:
        # Of several the one must be told; heads are shown without.
        part_of_axis(decoded(table_bytes(path, MAX_BYTES)), "", path)
    heads, stored = looked.heads, looked.stored
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
    kept = {k: v for k, v in stored.get("told", {}).items() if k in _REMEMBERED}
    told = {**kept, **given}
    plain = as_csv(looked.rows)
    with tempfile.TemporaryDirectory() as scratch:
        lone = Path(scratch) / f"{safe_name(path.stem)}.csv"
        write_text(lone, plain, "a table")
        columns: tuple[Column, ...] = ()
        of_file = not (answers or looked.of_channels) and any(kind.takes_alone(path) for kind in kinds())
        known = not answers and any(kind.takes_alone(lone) for kind in kinds())
        if of_file and not (known and looked.decimal):
            # What was taken for titles belongs to it, as the directions above blocks, or in a table on its side.
            known, plain = True, part_of_axis(decoded(table_bytes(path, MAX_BYTES, axis)), axis, path)
            write_text(lone, plain, "a table")
        if not known:
            columns, plain = in_house_form(looked, answers, path)
            write_text(lone, plain, "a table")
        kind = str(told.get("kind") or "") or _kind(lone, plain.partition("\n")[0].split(","), columns, path, told)
        above = kind_named(kind).told_above(path)
        told = {**kept, **above, **given}
        if not known:
            titled = kind_named(kind).titled(looked.titles, columns, looked.body, told, path)
            plain = with_titled_way(plain, titled)
            write_text(lone, plain, "a table")
            told |= titled
        missing = tuple(name for name in kind_named(kind).stated or () if name not in told)
        runs: tuple[tuple[str, int], ...] = ()
        if not missing:
            try:
                opened = open_table(lone, told)
                runs = tuple((run.meta.run_id, run.n_samples) for run in opened.read(opened.entries[0])[0])
            except InputError as error:
                # The user knows the file by its own name.
                error.where = (error.where or str(path)).replace(str(lone), str(path))
                raise
    return Understood(
        path,
        looked.encoding,
        looked.mark,
        looked.begin,
        columns,
        kind,
        told,
        missing,
        runs,
        str(stored.get("file") or "an earlier file") if stored else "",
        tuple(name for name in kept if name not in {**given, **above}),
        looked.decimal,
        looked.body[:_SHOWN],
        plain,
        heads,
        answers,
    )


def write_folder(understood: Understood, folder: Path, home: Home, *, confirmed: bool = False) -> Path:
    """Write a campaign folder and remember the answers; return its ``campaign.toml``, which is written last.

    ``confirmed``: whether the conditions of the earlier file hold for this one, too.

    Raises ``InputError`` when the folder is there already, conditions are missing, or are those of another file and
    not confirmed.
    """
    if understood.unconfirmed and not confirmed:
        raise InputError(
            "the conditions of an earlier file are not taken without being asked for",
            code="import.unconfirmed",
            where=str(understood.path),
            got=", ".join(f"{name} {understood.told[name]}" for name in understood.unconfirmed)
            + f", of {understood.remembered}",
            hint="--as-remembered, when this file was measured so, too; else the options that tell it",
        )
    if folder.exists():
        raise InputError(
            "the folder is there already", code="import.exists", where=str(folder), hint="--out with another name"
        )
    with tempfile.TemporaryDirectory() as scratch:
        lone = Path(scratch) / f"{safe_name(understood.path.stem)}.csv"
        write_text(lone, understood.text, "a table")
        opened = open_table(lone, understood.told, understood.path)
    campaign, (entry,) = opened.campaign, opened.entries
    # A comment: files of one campaign may differ in it.
    digest = hashlib.sha256(understood.path.read_bytes()).hexdigest()
    source = f"# dtwin import {json.dumps(understood.path.name)}, sha256 {digest}\n"
    kept = {name: understood.told[name] for name in _REMEMBERED if name in understood.told}
    recipe = {
        "header": list(understood.header),
        "columns": dict(understood.answers),
        "told": kept,
        "file": understood.path.name,
    }
    if understood.decimal:
        recipe["decimal"] = understood.decimal
    place = recipe_path(home, understood.header)
    try:
        make_folder(home.made().root / place.parent.name)
        make_folder(folder)
    except OSError as error:
        raise InputError(
            "a folder cannot be made", code="import.folder", where=str(error.filename), got=str(error.strerror)
        ) from error
    write_toml(place, recipe, "the recipe")
    write_text(folder / lone.name, understood.text, "the table")
    document = {
        "campaign": {
            "name": campaign.name,
            "machine": campaign.machine,
            "kind": understood.kind,
            **({"machine_geometry": dict(campaign.machine_geometry)} if campaign.machine_geometry else {}),
        },
        "run": [dict(entry.stated)],
    }
    return write_text(folder / "campaign.toml", source + tomli_w.dumps(document), "the campaign")


def _kind(lone: Path, names: Sequence[str], columns: Sequence[Column], path: Path, told: Mapping[str, Any]) -> str:
    for kind in kinds():
        if kind.takes_alone(lone) or (columns and set(names) >= set(kind.columns)):
            return kind.name
    raise InputError(
        "the columns are those of no kind of test",
        code="import.kind",
        where=str(path),
        got="; ".join(f"{c.head}: {c.name or c.why_not}" for c in columns)[:300],
        allowed="; ".join(f"{kind.name}: {', '.join(kind.columns)}" for kind in kinds()),
        hint=f"{_example(names, columns, told)} says what a column is, with the unit that the file has; heads that need no such word, as X [mm], Y [mm] of a circle: docs/how-to/ingest-your-own.md",
    )


def _example(names: Sequence[str], columns: Sequence[Column], told: Mapping[str, Any]) -> str:
    """Return the option for a column that a kind of test lacks: of the kind whose conditions are told, else of that whose columns are there."""

    def likely(kind: Kind) -> tuple[bool, int]:
        return bool(set(kind.stated or ()) & set(told)), len(set(kind.columns[1:]) & set(names))

    meant = max(kinds(), key=likely)
    free = [column for column in columns if column.name not in meant.columns] if any(likely(meant)) else []
    # A length is no angle.
    lacking = [name for name in meant.columns[1:] if name not in names]
    # A column without a unit may count its rows, and what was asked for is no reading.
    free = sorted((c for c in free if not _ASKED.search(c.head)), key=lambda column: not column.unit)
    pairs = ((c.head, n) for n in lacking for c in free if columns_of([c.head], [c.unit], {c.head: n})[0].name)
    head, name = next(pairs, ("", ""))
    return f'--column "{head}={name}", where that is a {meant.name} test,' if head else '--column "HEAD=NAME"'
