"""A table of another program: its heads, rows and titles, and the same in the house's columns."""

from __future__ import annotations

import csv
import io
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dtwin.acquire._recipes import recipe_of
from dtwin.acquire.axis_titles import part_of_axis
from dtwin.acquire.channel_log import as_table, is_channel_log
from dtwin.acquire.foreign_columns import (
    Column,
    below_heads,
    columns_of,
    converted,
    header_row,
    joined_heads,
    require_one_table,
    require_told_apart,
)
from dtwin.acquire.one_channel import require_one_channel
from dtwin.acquire.repeated_heads import require_heads_for_all
from dtwin.acquire.spreadsheet import table_bytes
from dtwin.acquire.table_dialect import DECIMALS, decoded, encoding_of, is_comment, mark_of, remarks_of, rows_of
from dtwin.acquire.title_words import require_usual_sign
from dtwin.atomic import write_text
from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.kinds.kind import Kind
from dtwin.kinds.registry import kinds

MAX_BYTES = 64 * 1024**2


@dataclass(frozen=True)
class Looked:
    """Heads and rows of a file, and what stands above, before anything is known of them; ``of_channels``: made of a log with one line a reading."""

    heads: tuple[str, ...]
    units: tuple[str, ...] | None
    body: tuple[tuple[str, ...], ...]
    begin: int
    encoding: str
    mark: str
    decimal: str
    stored: Mapping[str, Any]
    rows: tuple[tuple[str, ...], ...]
    titles: tuple[tuple[str, ...], ...]
    of_channels: bool


def look(path: Path, home: Home | None, decimal: str = "", axis: str = "") -> Looked:
    """Return the table of a file, and what is remembered of an earlier one with its heads.

    ``home``: where answers are remembered; without, nothing is.
    ``decimal``: ``comma`` or ``point``; empty: as it is remembered, else as the marks between columns tell.
    ``axis``: whose table is taken of a workbook or a text of several.

    Raises ``InputError`` when it is no table.
    """
    if decimal not in ("", *DECIMALS):
        raise InputError(
            "a decimal sign is a comma or a point", code="import.decimal", got=decimal[:20], allowed=", ".join(DECIMALS)
        )
    data = table_bytes(path, MAX_BYTES, axis)
    text = decoded(data)
    if of_channels := is_channel_log(text):
        text = as_table(text, path)
    elif axis:
        text = part_of_axis(text, axis, path)
    rows, begin, heads, stored, sign = _seen(text, path, home, decimal)
    units, body = below_heads(rows, begin)
    lines = [line for line in text.splitlines() if line.strip() and not is_comment(line)]
    return Looked(
        heads,
        None if units is None else tuple(units),
        tuple(map(tuple, body)),
        begin,
        encoding_of(data),
        mark_of(lines),
        sign,
        stored,
        tuple(map(tuple, rows[begin:])),
        tuple(map(tuple, [*remarks_of(text), *rows[:begin]])),
        of_channels,
    )


def _seen(
    text: str, path: Path, home: Home | None, decimal: str
) -> tuple[list[list[str]], int, tuple[str, ...], Mapping[str, Any], str]:
    """Return rows, the row of heads, the heads, what is remembered for them, and the decimal sign that is told or remembered."""
    require_heads_for_all(text, path)
    refused: InputError | None = None
    for sign in (decimal,) if decimal else ("", *DECIMALS):
        rows = [list(row) for row in joined_heads(rows_of(text, sign), path)]
        try:
            begin = header_row(rows, path)
        except InputError as error:
            # Numbers of another sign look like words; heads in two rows are for the kind that knows them.
            refused = refused or error
            if not rows or decimal or not any(kind.takes_alone(path) for kind in kinds()):
                continue
            begin = 0
        heads = tuple(cell.strip() for cell in rows[begin])
        stored = recipe_of(home, heads) if home else {}
        if decimal or stored.get("decimal", "") == sign:
            return rows, begin, heads, stored, sign
    assert refused is not None
    raise refused


def in_house_form(looked: Looked, answers: Mapping[str, str], path: Path) -> tuple[tuple[Column, ...], str]:
    """Return what each column is taken for, and the table as CSV in the house's columns.

    ``answers``: the house's column for a head of the file; an empty one leaves it out.

    Raises ``InputError`` when it holds several tables or channels, has the other sign, or columns that are not told apart.
    """
    require_one_table(looked.heads, looked.body, path, once=True)
    require_usual_sign([*looked.titles, looked.heads], path)
    columns = columns_of(looked.heads, looked.units, answers)
    require_told_apart(columns, looked.body, path)
    require_one_channel(looked.heads, looked.body, [i for i, one in enumerate(columns) if one.unit], path)
    return columns, as_csv(converted(columns, looked.body))


def with_titled_way(plain: str, titled: Mapping[str, Any]) -> str:
    """Return a table in the house's form with the direction that its titles tell."""
    # As a title it is that of readings that were sorted by the angle, too.
    return f"Direction: {titled['direction']}\n{plain}" if titled.get("direction") else plain


@contextmanager
def house_file(
    path: Path, kind: Kind, told: Mapping[str, Any], answers: Mapping[str, str], refused: InputError
) -> Iterator[Path]:
    """Give a file with a foreign table of a known kind in the house's columns; what is refused there names the user's file.

    ``told``: what is stated of the run.
    ``refused``: raised where it is no table.
    """
    try:
        looked = look(path, None)
    except InputError:
        raise refused from None
    columns, plain = in_house_form(looked, {h: n for h, n in answers.items() if h in looked.heads}, path)
    lacking = [name for name in kind.columns[1:] if name not in {column.name for column in columns}]
    if lacking:
        raise InputError(
            f"a {kind.name} run lacks columns",
            code="columns.missing",
            where=str(path),
            got="; ".join(f"{c.head}: {c.name or c.why_not}" for c in columns)[:300],
            allowed=", ".join(kind.columns),
            hint=f'state under [campaign.instrument.columns] what a head is, as "HEAD" = "{lacking[0]}"; with the unit of the file where the head has none',
        )
    with tempfile.TemporaryDirectory() as scratch:
        lone = Path(scratch) / f"{path.stem}.csv"
        titled = kind.titled(looked.titles, columns, looked.body, told, path)
        write_text(lone, with_titled_way(plain, titled), "a table")
        try:
            yield lone
        except InputError as error:
            error.where = (error.where or str(path)).replace(str(lone), str(path))
            raise


def as_csv(rows: Sequence[Sequence[str]]) -> str:
    """Return rows as CSV."""
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows(rows)
    return out.getvalue()
