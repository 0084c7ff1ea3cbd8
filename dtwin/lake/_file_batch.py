"""Data files of one table that are committed together, small ones in one file; their names say campaign and machine."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import pyarrow as pa
from numpy.typing import NDArray

from dtwin.lake.delta import DeltaFiles, Written, stem_of
from dtwin.lake.parquet import encoded, table_of
from dtwin.schema import Encoded, Run

# So many bytes of columns go into one file, at most.
_FILE_BYTES = 8 * 2**20


class _Part(NamedTuple):
    """Columns to write: path inside the table without ending, columns, and the bytes that they were read from."""

    stem: str
    columns: Mapping[str, NDArray[Any]]
    encoded: Encoded | None = None


class Batch:
    """Parts of one table, whose columns it accepts before the first is written.

    Parts of the same columns lie together in one file, each a group of its rows; a part that was read from a Parquet
    file is kept as that was.
    """

    def __init__(self, table: DeltaFiles, parts: Sequence[_Part]) -> None:
        self.table = table
        self._parts = [(part, table_of(part.columns)) for part in parts]
        self._schema = table.accepted([rows.schema for _, rows in self._parts])
        self._written: list[Written] = []

    def write(self) -> list[str]:
        """Write the files; return what :meth:`DeltaFiles.read_file` finds each part by."""
        files: list[list[tuple[_Part, pa.Table]]] = []
        for part, rows in self._parts:
            if files and _fits(files[-1], part, rows):
                files[-1].append((part, rows))
            else:
                files.append([(part, rows)])
        return [name for file in files for name in self._names(file)]

    def commit(self) -> None:
        """Make the files live in one step."""
        if self._written:
            self.table.commit(self._written, self._schema)

    def _names(self, file: Sequence[tuple[_Part, pa.Table]]) -> list[str]:
        """Write one file; return the names of its parts."""
        tables = [rows for _, rows in file]
        part, more = file[0][0], len(file) - 1
        data = part.encoded.data if _is_as_read(part) and part.encoded else encoded(*tables)
        stem = f"{part.stem}+{more}" if more else part.stem
        written = self.table.write_encoded(stem, data, sum(rows.num_rows for rows in tables))
        self._written.append(written)
        return [f"{written.name}#{k}" for k in range(len(file))] if more else [written.name]


def samples_part(run: Run, row: Mapping[str, Any]) -> _Part:
    """Return the samples of a run; ``row``: of the table of runs."""
    return _Part(f"{row['campaign']}/{run.meta.run_id}", run.samples)


def signal_parts(run: Run, row: Mapping[str, Any]) -> list[_Part]:
    """Return each group of signals of a run; ``row`` as above."""
    stem = f"{row['campaign']}/{run.meta.run_id}"
    return [_Part(f"{stem}-{group.name}", group.columns, group.encoded) for group in run.signals]


def _is_as_read(part: _Part) -> bool:
    """Tell whether the columns of a part were not replaced since they were read."""
    return part.encoded is not None and part.encoded.columns is part.columns


def _fits(file: Sequence[tuple[_Part, pa.Table]], part: _Part, rows: pa.Table) -> bool:
    """Tell whether a part may lie in a file beside those that are there."""
    first, there = file[0]
    size = sum(other.nbytes for _, other in file) + rows.nbytes
    alike = rows.schema.equals(there.schema, check_metadata=True)
    return alike and size <= _FILE_BYTES and not _is_as_read(first) and not _is_as_read(part)


def names_of(told: str | Collection[str] | None) -> set[str] | None:
    """Return names that were asked for, None for all."""
    return {told} if isinstance(told, str) else None if told is None else set(told)


def campaign_named(file: str) -> str:
    """Return the campaign whose rows a file holds."""
    return stem_of(file).split("/")[0]


def of_machines(files: Sequence[str], machines: Collection[str], anew: Collection[str]) -> list[str]:
    """Return the files of runs of machines; what was stated ``anew`` of a campaign may be its machine."""
    return [f for f in files if machine_named(f) in {*machines, None} or campaign_named(f) in anew]


def machine_named(file: str) -> str | None:
    """Return the machine of which a campaign was ingested; None where the name of its file does not say."""
    return stem_of(file).partition("/")[2] or None
