"""Parquet files that notice damage: page checksums written, and verified on every read."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from dtwin.errors import StoreError
from dtwin.units import unit_of

# A column that lies in one group is read without being copied together.
_ROW_GROUP_ROWS = 2**22


def table_of(columns: Mapping[str, NDArray[Any] | Sequence[Any]]) -> pa.Table:
    """Return an Arrow table whose fields carry their units.

    Parameters
    ----------
    columns : mapping of str to array, shape (n,)
        Columns of equal length; strings become text columns.
    """
    arrays = [_array(values) for values in columns.values()]
    fields = [
        pa.field(name, array.type, metadata=_unit_metadata(name))
        for name, array in zip(columns, arrays, strict=True)
    ]
    return pa.table(arrays, schema=pa.schema(fields))


def write_parquet(path: Path, table: pa.Table) -> int:
    """Write a table so that damage is noticed, and return its size in bytes.

    Floats are byte-stream split, integers delta packed, text dictionary encoded, all zstd.
    The file appears under its name only when it is complete and on disk.

    Parameters
    ----------
    path : Path
        File to write; its folder is created.
    table : pyarrow.Table
        What to write.

    Raises
    ------
    StoreError
        When the folder is read-only or full; nothing is left behind.
    """
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(
            table,
            partial,
            compression="zstd",
            compression_level=1,
            use_dictionary=[f.name for f in table.schema if _is_text(f.type)],
            column_encoding=_encodings(table.schema) or None,
            write_page_checksum=True,
            write_statistics=True,
            row_group_size=_ROW_GROUP_ROWS,
        )
        with partial.open("rb") as written:
            os.fsync(written.fileno())
        partial.replace(path)
        return path.stat().st_size
    except OSError as error:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
        raise StoreError(
            "the file cannot be written",
            code="store.write",
            where=str(path),
            got=str(error),
            hint="check free space and permissions; nothing was left half-written",
        ) from error


def read_parquet(path: Path, columns: Sequence[str] | None = None) -> pa.Table:
    """Read a table, verifying every page's checksum.

    Parameters
    ----------
    path : Path
        File written by :func:`write_parquet`.
    columns : sequence of str, optional
        Columns to read; all by default.

    Raises
    ------
    StoreError
        When the file is missing or damaged.
    """
    try:
        return pq.ParquetFile(path, page_checksum_verification=True).read(
            columns=None if columns is None else list(columns)
        )
    except (OSError, pa.ArrowException) as error:
        raise StoreError(
            "a data file is missing or damaged",
            code="store.damaged",
            where=str(path),
            got=str(error)[:200],
            hint="restore the file from a backup, or ingest its source again",
        ) from error


def columns_of(table: pa.Table) -> dict[str, NDArray[Any]]:
    """Return the columns of a table as arrays, text as object arrays."""
    return {
        name: np.array(table.column(name).to_pylist(), dtype=object)
        if _is_text(table.schema.field(name).type)
        else table.column(name).to_numpy()
        for name in table.column_names
    }


def _array(values: NDArray[Any] | Sequence[Any]) -> pa.Array:
    array = values if isinstance(values, pa.Array) else pa.array(values)
    return array.cast(pa.string()) if pa.types.is_large_string(array.type) else array


def _unit_metadata(name: str) -> dict[str, str] | None:
    unit = unit_of(name)
    return None if unit is None else {"unit": unit}


def _is_text(kind: pa.DataType) -> bool:
    return bool(pa.types.is_string(kind) or pa.types.is_large_string(kind))


def _encodings(schema: pa.Schema) -> dict[str, str]:
    chosen = {}
    for field in schema:
        if pa.types.is_floating(field.type):
            chosen[field.name] = "BYTE_STREAM_SPLIT"
        elif pa.types.is_integer(field.type):
            chosen[field.name] = "DELTA_BINARY_PACKED"
    return chosen
