"""Parquet files that notice damage: page checksums written, and verified on every read."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from dtwin.atomic import whole_file
from dtwin.errors import StoreError
from dtwin.units import unit_of

# A column that lies in one group is read without being copied together.
_ROW_GROUP_ROWS = 2**22
# Says that the pages of a file carry checksums: pyarrow verifies them only where they are.
_CHECKSUMS = {b"dtwin.page_checksums": b"crc32"}
NUMBERS = (pa.float64(), pa.float32(), pa.int64(), pa.int32(), pa.int16())
"""Types of numbers that the lake keeps."""


def table_of(columns: Mapping[str, NDArray[Any] | Sequence[Any]]) -> pa.Table:
    """Return an Arrow table of columns (n,), whose fields carry their units; strings become text columns."""
    arrays = [_array(values) for values in columns.values()]
    fields = [
        pa.field(name, array.type, metadata=unit_metadata(name)) for name, array in zip(columns, arrays, strict=True)
    ]
    return pa.table(arrays, schema=pa.schema(fields))


def write_parquet(path: Path, table: pa.Table) -> int:
    """Write a table, making its folder, so that damage is noticed, and return its size in bytes.

    Floats are byte-stream split, integers delta packed, text dictionary encoded, all zstd.
    The file appears under its name only when it is complete and on disk.

    Raises ``StoreError`` when the folder is read-only or full; nothing is left behind.
    """
    return write_bytes(path, encoded(table))


def encoded(*tables: pa.Table) -> memoryview:
    """Return tables of one schema as the bytes of a Parquet file with page checksums.

    Several tables are a group of rows each; a single one is as many as it needs.
    """
    sink = pa.BufferOutputStream()
    schema = tables[0].schema.with_metadata((tables[0].schema.metadata or {}) | _CHECKSUMS)
    with pq.ParquetWriter(
        sink,
        schema,
        compression="zstd",
        compression_level=1,
        use_dictionary=[f.name for f in schema if _is_text(f.type)],
        column_encoding=_encodings(schema) or None,
        write_page_checksum=True,
        write_statistics=True,
    ) as writer:
        for table in tables:
            writer.write_table(table.cast(schema), row_group_size=_ROW_GROUP_ROWS)
    return memoryview(sink.getvalue())


def write_bytes(path: Path, data: bytes | memoryview) -> int:
    """Write the bytes of a Parquet file, and return their number; raises as above."""
    with whole_file(path, "the file") as partial:
        partial.write_bytes(data)
    return len(data)


def read_parquet(path: Path) -> pa.Table:
    """Read a table, verifying every page's checksum.

    ``path``: any Parquet file; pages without checksums are read as they are.
    Raises ``StoreError`` when the file is missing or damaged.
    """
    return read_encoded(path)[0]


def read_encoded(path: Path) -> tuple[pa.Table, memoryview | None]:
    """Read a table as :func:`read_parquet` does, and the bytes that it was verified from.

    Returns ``table``: its rows.
    Returns ``data``: the file; None when it is not one of :func:`write_parquet`, so that its pages may lack checksums.
    """
    return decoded(lambda: content_of(path), str(path))


def decoded(
    content: Callable[[], pa.Buffer],
    where: str,
    verify: Callable[[memoryview], None] | None = None,
    group: int | None = None,
) -> tuple[pa.Table, memoryview | None]:
    """Return what :func:`read_encoded` does of a Parquet file, wherever it lies.

    ``content``: returns the file in memory of Arrow; raises OSError.
    ``where``: the file, for the error message.
    ``verify``: raises OSError for a file that is damaged; its pages are then not checked one by one.
    ``group``: the one group of rows to read.
    """
    try:
        buffer = content()
        data = memoryview(buffer)
        if verify is not None:
            verify(data)
        whole = pq.ParquetFile(pa.BufferReader(buffer), page_checksum_verification=verify is None)
        table = whole.read() if group is None else whole.read_row_group(group)
    # Damaged names of columns end in UnicodeDecodeError.
    except (OSError, pa.ArrowException, ValueError) as error:
        raise StoreError(
            "a data file is missing or damaged",
            code="store.damaged",
            where=where,
            got=str(error)[:200],
            hint="restore the file from a backup, or ingest its source again",
        ) from error
    return table, data if _CHECKSUMS.items() <= (table.schema.metadata or {}).items() else None


def content_of(path: Path) -> pa.Buffer:
    """Return the content of a file, in memory of Arrow.

    Not of Python: a thread of Arrow that frees the last reference to Python's while the process ends
    would abort it (seen about once in 5000 reads).
    """
    if path.exists() and not path.is_file():
        # A pipe would be waited for.
        raise OSError("no regular file")
    with pa.OSFile(str(path)) as file:
        return file.read_buffer()


def columns_of(table: pa.Table) -> dict[str, NDArray[Any]]:
    """Return the columns of a table as arrays, text as object arrays."""
    return {
        name: np.array(table.column(name).to_pylist(), dtype=object)
        if _is_text(table.schema.field(name).type)
        else numbers_of(table.column(name))
        for name in table.column_names
    }


def numbers_of(column: pa.ChunkedArray) -> NDArray[Any]:
    """Return a column as an array: by ``to_numpy`` only where it must be, for that imports pandas, a third of a second."""
    plain = pa.types.is_floating(column.type) or pa.types.is_integer(column.type)
    if column.null_count or not column.num_chunks or not plain:
        return column.to_numpy()
    parts = [np.from_dlpack(chunk) for chunk in column.chunks]
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def _array(values: NDArray[Any] | Sequence[Any]) -> pa.Array:
    array = values if isinstance(values, pa.Array) else pa.array(values)
    return array.cast(pa.string()) if pa.types.is_large_string(array.type) else array


def unit_metadata(name: str) -> dict[str, str] | None:
    """Return what a file says of a column: its unit, which its name tells; none when it has none."""
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
