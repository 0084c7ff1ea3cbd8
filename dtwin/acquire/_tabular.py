"""Measured columns from CSV and Parquet files."""

from __future__ import annotations

import io
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pa_csv
import pyarrow.parquet as pq
from numpy.typing import NDArray

from dtwin.acquire._parquet_file import foreign_table
from dtwin.acquire._readings import usable
from dtwin.acquire.repeated_heads import require_heads, require_whole_end
from dtwin.acquire.spreadsheet import ending_as_table, is_spreadsheet, table_bytes
from dtwin.acquire.table_dialect import encoding_of, is_comment, marked_heads
from dtwin.acquire.xmlsafe import require_bounded
from dtwin.errors import InputError
from dtwin.kinds.registry import kind_named, kinds
from dtwin.lake.parquet import NUMBERS, numbers_of
from dtwin.units import require_units

_MAX_TABLE_BYTES = 512 * 1024**2
_LONGEST_BEGIN, _LONGEST_END = 2**20, 40_000
_MOST_COMMENTS, _MOST_LOOKED_AT = 1000, 100
_UNEVEN = re.compile(r"Row #(\d+): Expected (\d+) columns, got (\d+): ?(.*)", re.S)
"""What the reader of CSV says of a row that is longer or shorter than the first."""
# Text that names a state rather than measuring something.
_TEXT_COLUMNS = frozenset({"direction"})
_CODED = dict.fromkeys(_TEXT_COLUMNS, pa.dictionary(pa.int32(), pa.string()))


def read_columns(path: Path, kind: str) -> tuple[dict[str, NDArray[Any]], list[dict[str, Any]]]:
    """Read the samples of one run.

    ``path``: ``.csv`` or ``.parquet``.
    ``kind``: kind of campaign; decides which columns must be there.
    Returns ``columns`` (n,): columns without the rejected rows.
    Returns ``rejects``: rows that hold no usable number, each with ``row`` (from 0), ``reason`` and ``values``.
    """
    required = kind_named(kind).columns
    table = _with_names(_read_table(path), path, required)
    columns: dict[str, NDArray[Any]] = {}
    for name in table.column_names:
        columns[name] = _as_array(table, name, path)
        # What is an array need not be held as a column, too.
        table = table.drop_columns([name])
    pa.default_memory_pool().release_unused()
    missing = [name for name in required if name not in columns]
    if missing:
        raise InputError(
            f"a {kind} run lacks columns",
            code="columns.missing",
            where=str(path),
            got=", ".join(columns)[:200],
            allowed=", ".join(required),
            hint="rename the columns, and convert their values to the units at the ends of these names",
        )
    floats = [name for name, values in columns.items() if values.dtype.kind == "f"]
    require_units(floats, str(path))
    return _drop_bad_rows(columns, floats, path)


def kind_of_table(path: Path) -> str:
    """Return the kind of campaign whose columns a table has."""
    alone = next((kind.name for kind in kinds() if kind.takes_alone(path)), None)
    if alone is not None:
        return alone
    heads = _names(path)
    names = set(heads)
    for kind in kinds():
        if names.issuperset(kind.columns):
            return kind.name
    require_heads(heads, path, "; ".join(", ".join(kind.columns) for kind in kinds()))
    raise InputError(
        "the columns are those of no kind of test",
        code="columns.missing",
        where=str(path),
        got=", ".join(sorted(names))[:200],
        allowed="; ".join(f"{kind.name}: {', '.join(kind.columns)}" for kind in kinds()),
        hint=f"dtwin import {path.name} reads tables of other programs; --kind states what heads do not tell, as --kind rotation; else rename the columns",
    )


def is_parquet_of_a_kind(path: Path) -> bool:
    """Return whether a file of Parquet has the columns of a kind of test, and beside them nothing but numbers; its rows are not read."""
    try:
        schema = pq.read_schema(path)
        types = [field.type for field in schema if field.name not in _TEXT_COLUMNS]
    # Damaged names of columns end in UnicodeDecodeError.
    except (pa.ArrowException, OSError, ValueError) as error:
        raise _malformed(path, error) from error
    numbers = all(t in NUMBERS or pa.types.is_decimal(t) or pa.types.is_temporal(t) for t in types)
    return numbers and any(set(schema.names).issuperset(kind.columns) for kind in kinds())


def _read_table(path: Path) -> pa.Table:
    suffix = ending_as_table(path)
    if suffix not in (".csv", ".parquet"):
        raise InputError(
            "unknown kind of table",
            code="table.type",
            where=str(path),
            got=suffix or "no ending",
            allowed=".csv, .parquet, .xlsx",
        )
    require_bounded(path, _MAX_TABLE_BYTES)
    try:
        if suffix == ".parquet":
            return foreign_table(path)
        # In blocks, so that the file itself is never in memory; the first block alone does not tell integers from floats.
        numbers = {name: pa.float64() for name in _names(path) if name not in _TEXT_COLUMNS}
        with pa_csv.open_csv(_source(path), **_dialect(path, numbers)) as opened:
            return opened.read_all()
    except (pa.ArrowException, OSError, ValueError) as error:
        raise _malformed(path, error) from error


def _with_names(table: pa.Table, path: Path, required: Sequence[str]) -> pa.Table:
    """Return a table without empty columns that need not be there, such as separators at the ends of lines make; refuse one name for two."""
    names = table.column_names
    filled = [i for i, name in enumerate(names) if name in required or table.column(i).null_count < table.num_rows]
    table = table.select(filled)
    twice = sorted({name for name in table.column_names if table.column_names.count(name) > 1})
    if twice:
        raise InputError(
            "two columns have one name",
            code="columns.twice",
            where=str(path),
            got=", ".join(twice)[:80] or "columns without a name",
            allowed="a name for each column",
        )
    return table


def _names(path: Path) -> list[str]:
    if ending_as_table(path) != ".csv":
        return list(_read_table(path).column_names)
    require_bounded(path, _MAX_TABLE_BYTES)
    try:
        with pa_csv.open_csv(_source(path), **_dialect(path)) as opened:
            return list(opened.schema.names)
    except (pa.ArrowException, OSError, ValueError) as error:
        raise _malformed(path, error) from error


def _source(path: Path) -> Path | io.BytesIO:
    return io.BytesIO(table_bytes(path, _MAX_TABLE_BYTES)) if is_spreadsheet(path) else path


def _dialect(path: Path, numbers: Mapping[str, pa.DataType] = MappingProxyType({})) -> dict[str, Any]:
    """Return the encoding of a file, how it parts its columns and writes decimals, by its first line that is no comment.

    ``numbers``: types of columns that are known.
    Spreadsheets of many countries part columns by semicolons and write decimal commas.
    """
    source = _source(path)
    with source.open("rb") if isinstance(source, Path) else source as file:
        begin = file.read(_LONGEST_BEGIN)
        # Of whole pairs of bytes: some encodings have two for a letter.
        file.seek(max(0, file.seek(0, os.SEEK_END) - _LONGEST_END) // 2 * 2)
        end = file.read()
    encoding = encoding_of(begin)
    require_whole_end(end.decode(encoding, "replace"), path)
    lines = begin.decode(encoding, "replace").split("\n", _MOST_COMMENTS + 1)
    comments = next((n for n, line in enumerate(lines[:_MOST_COMMENTS]) if not is_comment(line)), _MOST_COMMENTS)
    marked = marked_heads(lines[:_MOST_COMMENTS])
    head = marked[2] if marked else lines[comments] if comments < len(lines) else ""
    european = ";" in head and "," not in head
    readings = "".join(lines[(marked[1] if marked else comments + 1) : -1][:_MOST_LOOKED_AT])
    comma = european and ("," in readings or "." not in readings)
    read_options = pa_csv.ReadOptions(skip_rows=comments, encoding=encoding.removesuffix("-sig"))
    if marked:
        read_options.skip_rows = marked[1]
        read_options.column_names = [name.strip() for name in head.split(";" if european else ",")]
    return {
        "read_options": read_options,
        "parse_options": pa_csv.ParseOptions(delimiter=";" if european else ","),
        "convert_options": pa_csv.ConvertOptions(
            decimal_point="," if comma else ".", column_types={**_CODED, **numbers}
        ),
    }


def _malformed(path: Path, error: Exception) -> InputError:
    if "conversion error" in str(error):
        return _not_numeric(path, "", error)
    if ending_as_table(path) == ".parquet":
        return InputError(
            "the file of Parquet cannot be read",
            code="table.malformed",
            where=str(path),
            got=str(error)[-160:],
            allowed="a whole file of Parquet",
            hint="it may be cut short or damaged: copy or write it again",
        )
    uneven = _UNEVEN.search(str(error))
    # What is read at once is a megabyte.
    got = (
        "one line without an end, or of more than a megabyte" if "infer number of columns" in str(error) else str(error)
    )
    if uneven:
        row, heads, cells, text = uneven.groups()
        got = f"row {row} has {cells} cell{'s' * (cells != '1')}, the first row {heads}: {text.strip()}"
    return InputError(
        "the rows of the table are not alike, and it has no form that is known otherwise"
        if uneven
        else "the table cannot be read",
        code="table.malformed",
        where=str(path),
        got="bytes that are no text" if isinstance(error, UnicodeDecodeError) else got[:200],
        allowed="columns parted by commas with decimal points, or by semicolons with decimal commas or points",
        hint=f"dtwin import {path.name} reads tables of other programs; else the file may be cut short or damaged",
    )


def _as_array(table: pa.Table, name: str, path: Path) -> NDArray[Any]:
    column = table.column(name)
    if pa.types.is_timestamp(column.type) and name == "t_s":
        # From the first one on: seconds since 1970 leave no digits for a fast clock.
        column = pc.subtract(column, pc.min(column))
    if pa.types.is_duration(column.type) and name.endswith("_s"):
        column = pc.divide(column.cast(pa.duration("ns")).cast(pa.int64()).cast(pa.float64()), 1e9)
    if name in _TEXT_COLUMNS:
        # One string for all cells that say the same.
        coded = column.cast(pa.string()).dictionary_encode(null_encoding="encode").combine_chunks()
        words = np.array(coded.dictionary.to_pylist(), dtype=object)
        return words[np.from_dlpack(coded.indices)]
    try:
        if pa.types.is_boolean(column.type):
            raise ValueError("true and false")
        return numbers_of(column.cast(pa.float64()))
    except (pa.ArrowException, ValueError) as error:
        raise _not_numeric(path, name[:60], error) from error


def _not_numeric(path: Path, column: str, error: Exception) -> InputError:
    return InputError(
        "a column is not numeric",
        code="columns.number",
        where=f"{path} {column}".strip(),
        got=str(error)[:120],
        allowed="numbers with a decimal point, of the unit at the end of the column's name",
        hint=f"dtwin import {path.name} --out FOLDER leaves columns of words out and reads other forms of numbers; else take the column out of the table",
    )


def _drop_bad_rows(
    columns: dict[str, NDArray[Any]], floats: list[str], path: Path
) -> tuple[dict[str, NDArray[Any]], list[dict[str, Any]]]:
    finite = np.ones(len(columns[floats[0]]), dtype=bool)
    for name in floats:
        finite &= usable(columns[name])
    if not finite.any():
        raise InputError("no row holds finite numbers", code="table.no_rows", where=str(path))
    if finite.all():
        return columns, []
    rejects = [
        {
            "row": int(row),
            "reason": "no usable number: " + ", ".join(n for n in floats if not usable(columns[n][row])),
            "values": {name: repr(columns[name][row].item()) for name in floats},
        }
        for row in np.flatnonzero(~finite)
    ]
    return {name: values[finite] for name, values in columns.items()}, rejects
