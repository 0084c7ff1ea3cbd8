"""Files of Parquet that nobody vouches for: how large they become is asked before they are unpacked."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from dtwin.errors import InputError

_MOST_VALUES = 2**27
"""Of numbers of eight bytes, 1 GB."""
_LONGEST_CELL = 32_767


def foreign_table(path: Path, content: pa.BufferReader | None = None) -> pa.Table:
    """Return the table of a file; words stand once each, however often they come.

    ``content``: of the file, where it is in memory.
    Raises ``InputError`` where it would be too large; errors of Arrow and of reading go on.
    """
    source = content or path
    require_moderate(path, content)
    schema = pq.read_metadata(source).schema
    # By what is stored: types of Arrow for words are many.
    words = [column.path for column in map(schema.column, range(len(schema))) if column.physical_type == "BYTE_ARRAY"]
    if content is not None:
        content.seek(0)
    file = pq.ParquetFile(source, page_checksum_verification=True, read_dictionary=words)
    batches = []
    for batch in file.iter_batches(batch_size=2**16):
        for name in words:
            longest = pc.max(pc.binary_length(batch.column(name).dictionary)).as_py() or 0
            if longest > _LONGEST_CELL:
                raise _too_large(path, f"a cell of {longest} bytes in {name[:40]!r}", f"up to {_LONGEST_CELL} bytes")
        batches.append(batch)
    return pa.Table.from_batches(batches, schema=file.schema_arrow if not batches else None)


def require_moderate(path: Path, content: pa.BufferReader | None = None, *, most_values: int = _MOST_VALUES) -> None:
    """Refuse a file whose rows would not fit in memory, for what is equal in all rows is packed into next to nothing, or hold lists."""
    told = pq.read_metadata(content or path)
    # How many values a list holds stands in the records of its column, and one of these that is damaged ends the process.
    nested = next((field for field in told.schema.to_arrow_schema() if pa.types.is_nested(field.type)), None)
    if nested is not None:
        raise InputError(
            "a column holds more than a value in a cell",
            code="table.nested",
            where=f"{path} {nested.name[:60]}",
            got=str(nested.type)[:80],
            allowed="numbers, times and words",
            hint="write a column for each part of it, or leave it out",
        )
    groups = [told.row_group(n) for n in range(told.num_row_groups)]
    values = sum(group.num_rows * group.num_columns for group in groups)
    columns = map(told.schema.column, range(len(told.schema)))
    fixed = sum(column.length for column in columns if column.physical_type == "FIXED_LEN_BYTE_ARRAY")
    held = sum(group.total_byte_size for group in groups) + fixed * told.num_rows
    if values > most_values:
        raise _too_large(path, f"{values} values", f"up to {most_values} values")
    if held > 8 * most_values:
        raise _too_large(path, f"{held / 1e6:z.0f} MB unpacked", f"up to {8 * most_values / 1e6:z.0f} MB")


def _too_large(path: Path, got: str, allowed: str) -> InputError:
    return InputError(
        "the file of Parquet is too large when it is unpacked",
        code="table.too_large",
        where=str(path),
        got=got,
        allowed=allowed,
        hint="part it into runs, or thin it out",
    )
