"""One Delta table whose Parquet files are written and read by us, committed by deltalake."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
from deltalake import DeltaTable
from deltalake.exceptions import CommitFailedError, DeltaError, TableNotFoundError
from deltalake.schema import Field, PrimitiveType
from deltalake.transaction import AddAction, RemoveAction

from dtwin.errors import StoreError
from dtwin.parquet import read_parquet, write_encoded, write_parquet
from dtwin.schema import Encoded
from dtwin.units import unit_of

_TYPES = {
    pa.string(): "string",
    pa.float64(): "double",
    pa.float32(): "float",
    pa.int64(): "long",
    pa.int32(): "integer",
    pa.bool_(): "boolean",
}
_COMMIT_TRIES = 20


class DeltaFiles:
    """A Delta table made of whole files that are added and removed atomically.

    Parameters
    ----------
    folder : Path
        Folder of the table; created with the first commit.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def exists(self) -> bool:
        """Tell whether the table was ever written."""
        return (self.folder / "_delta_log").is_dir()

    def version(self) -> int:
        """Return the current table version; -1 when the table does not exist."""
        return self._open().version() if self.exists() else -1

    def files(self, version: int | None = None) -> list[str]:
        """Return the relative paths of the live data files.

        Parameters
        ----------
        version : int, optional
            Table version to look at; the newest by default.
        """
        if not self.exists() or version == -1:
            return []
        return _live_files(self._open(version))

    def write(self, name: str, table: pa.Table) -> tuple[str, int, int]:
        """Write a data file without committing it.

        Parameters
        ----------
        name : str
            Relative path of the file, ending in ``.parquet``.
        table : pyarrow.Table
            Its rows.

        Returns
        -------
        name, bytes, rows : tuple
            What :meth:`commit` needs.
        """
        return name, write_parquet(self.folder / name, table), table.num_rows

    def write_encoded(self, name: str, encoded: Encoded, rows: int) -> tuple[str, int, int]:
        """Write a data file as it was read, without committing it; otherwise as :meth:`write`."""
        return name, write_encoded(self.folder / name, encoded), rows

    def commit(self, written: Sequence[tuple[str, int, int]], schema: pa.Schema) -> int:
        """Add files to the table in one atomic step.

        Files that are live already are left alone, so a repeated commit changes nothing.

        Parameters
        ----------
        written : sequence of (name, bytes, rows)
            Files from :meth:`write`.
        schema : pyarrow.Schema
            Union of their columns; new columns extend the table, a changed type is refused.

        Returns
        -------
        int
            Table version after the commit.
        """
        table = self._with_columns(schema)
        for attempt in range(_COMMIT_TRIES):
            live = set(_live_files(table))
            now_ms = int(time.time() * 1000)
            actions: list[AddAction | RemoveAction] = [
                AddAction(name, size, {}, now_ms, True, json.dumps({"numRecords": rows}))
                for name, size, rows in written
                if name not in live
            ]
            if not actions:
                return table.version()
            try:
                table.create_write_transaction(actions, "append", table.schema(), [])
            except CommitFailedError:
                time.sleep(0.02 * (attempt + 1))
                table = self._open()
                continue
            except (DeltaError, OSError) as error:
                raise self._refused(error) from error
            return self.version()
        raise StoreError(
            "another writer kept the table busy",
            code="store.busy",
            where=str(self.folder),
            hint="wait for the other ingest to finish and run this again",
        )

    def remove(self, names: Sequence[str]) -> int:
        """Take files out of the table; the files themselves stay for time travel."""
        table = self._open()
        actions: list[AddAction | RemoveAction] = [
            RemoveAction(
                path=row["path"],
                data_change=True,
                deletion_timestamp=int(time.time() * 1000),
                size=row["size_bytes"],
                partition_values={},
            )
            for row in pa.table(table.get_add_actions()).to_pylist()
            if row["path"] in set(names)
        ]
        if actions:
            table.create_write_transaction(actions, "append", table.schema(), [])
        return self.version()

    def read(
        self, names: Sequence[str] | None = None, columns: Sequence[str] | None = None
    ) -> pa.Table:
        """Read live files with their checksums verified.

        Parameters
        ----------
        names : sequence of str, optional
            Files to read; all live ones by default.
        columns : sequence of str, optional
            Columns to read; files that lack one give nulls.
        """
        chosen = self.files() if names is None else list(names)
        parts = []
        for name in chosen:
            part = read_parquet(self.folder / name)
            parts.append(
                part
                if columns is None
                else part.select([c for c in columns if c in part.column_names])
            )
        if not parts:
            return pa.table({})
        return pa.concat_tables(parts, promote_options="default")

    def _open(self, version: int | None = None) -> DeltaTable:
        try:
            return DeltaTable(self.folder, version=version)
        except (TableNotFoundError, DeltaError, OSError) as error:
            raise StoreError(
                "the table cannot be opened",
                code="store.open",
                where=str(self.folder),
                got=str(error)[:200],
            ) from error

    def _with_columns(self, schema: pa.Schema) -> DeltaTable:
        """Return the newest table, made or extended so that it has these columns."""
        wanted = {field.name: field for field in schema}
        table = self._open() if self.exists() else self._create(schema)
        present = {field.name: field.type for field in table.schema().fields}
        for name, field in wanted.items():
            kind = PrimitiveType(_delta_type(field.type, name, self.folder))
            if name in present and present[name] != kind:
                raise StoreError(
                    "a column changed its type",
                    code="store.schema",
                    where=f"{self.folder} {name}",
                    got=str(field.type),
                    allowed=str(present[name]),
                )
        fresh = [name for name in wanted if name not in present]
        if fresh:
            table.alter.add_columns(
                [_delta_field(name, wanted[name], self.folder) for name in fresh]
            )
            return self._open()
        return table

    def _create(self, schema: pa.Schema) -> DeltaTable:
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            return DeltaTable.create(self.folder, schema=schema, mode="ignore")
        except (DeltaError, OSError) as error:
            raise self._refused(error) from error

    def _refused(self, error: Exception) -> StoreError:
        return StoreError(
            "the lake cannot be written",
            code="store.write",
            where=str(self.folder),
            got=str(error)[:200],
            hint="check free space and permissions; nothing was committed",
        )


def _live_files(table: DeltaTable) -> list[str]:
    actions = pa.table(table.get_add_actions())
    return sorted(actions.column("path").to_pylist())


def metadata_of(name: str) -> Mapping[str, Any]:
    """Return the Delta field metadata of a column."""
    unit = unit_of(name)
    return {} if unit is None else {"unit": unit}


def _delta_type(kind: pa.DataType, name: str, folder: Path) -> str:
    if kind not in _TYPES:
        raise StoreError(
            "a column has a type that the lake does not keep",
            code="store.schema",
            where=f"{folder} {name}",
            got=str(kind),
            allowed=", ".join(map(str, _TYPES)),
        )
    return _TYPES[kind]


def _delta_field(name: str, field: pa.Field, folder: Path) -> Field:
    kind = PrimitiveType(_delta_type(field.type, name, folder))
    return Field(name, kind, nullable=True, metadata=dict(metadata_of(name)))
