"""One Delta table whose Parquet files are written and read by us, committed by deltalake."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import pyarrow as pa
from deltalake import DeltaTable
from deltalake.exceptions import CommitFailedError, DeltaError, TableNotFoundError
from deltalake.schema import Schema as DeltaSchema
from deltalake.transaction import AddAction, CommitProperties, PostCommitHookProperties, RemoveAction

from dtwin.atomic import make_folder, sync
from dtwin.errors import StoreError
from dtwin.lake._delta_columns import LIVE, added, content_hash, declared, live_hash, sort_of
from dtwin.lake._log import Log
from dtwin.lake.parquet import encoded, read_encoded, write_bytes

_COMMIT_TRIES = 20
# Log entries stay: repair reads in them which files were ever committed.
_KEEP_LOG = PostCommitHookProperties(cleanup_expired_logs=False)
# Hexadecimal digits of its own hash that the name of a data file ends with.
_DIGITS = 24
_NAME = re.compile(rf"[^\x00]+\.([0-9a-f]{{{_DIGITS}}})\.parquet")
# One group of rows of a data file.
_PART = re.compile(r"([^\x00]+\.parquet)#([0-9]{1,6})")


class Written(NamedTuple):
    """A data file that is on disk and not yet committed: name inside the table, bytes, rows."""

    name: str
    size: int
    rows: int


def file_of(name: str) -> str:
    """Return the file that a name of a file, or of a group of rows in one, means."""
    return _split(name)[0]


def part_of(name: str) -> int:
    """Return which group of rows of its file a name means, the first where it means the whole file."""
    return _split(name)[1] or 0


def stem_of(name: str) -> str:
    """Return the name of a file without its hash and ending."""
    return name.rsplit(".", 2)[0]


class DeltaFiles:
    """A Delta table made of whole files that are added and removed atomically.

    Parameters
    ----------
    folder : Path
        Folder of the table; created with the first commit.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.log = Log(folder / "_delta_log")

    def exists(self) -> bool:
        """Tell whether the table was ever written."""
        return self.log.folder.is_dir()

    def version(self) -> int:
        """Return the current table version; -1 when the table does not exist."""
        return self.log.newest()

    def files(self, version: int | None = None) -> list[str]:
        """Return the relative paths of the live data files.

        Parameters
        ----------
        version : int, optional
            Table version to look at; the newest by default.
        """
        if not self.exists() or version == -1:
            return []
        return sorted(self._verified(self._open(version)))

    def is_earlier(self) -> bool:
        """Tell whether no entry of the log has a hash of the live files: version 0.1 wrote none."""
        if not self.exists():
            return False
        try:
            return not any(LIVE in path.read_text(encoding="utf-8") for path in self.log.entries())
        except (OSError, ValueError):
            return False

    def earlier_files(self) -> list[str]:
        """Return the live files of a table whose log has no hashes, sorted."""
        return sorted(self._open().get_add_actions()["path"].to_pylist()) if self.exists() else []

    def accepted(self, schemas: Iterable[pa.Schema]) -> pa.Schema:
        """Return the columns of several files that are to be written.

        Raises
        ------
        StoreError
            When a column that holds numbers would hold text, or the other way round.
        """
        fields = self._open().schema().fields if self.exists() else []
        present = {field.name: str(field.type.type) for field in fields}
        union: dict[str, pa.Field] = {}
        for field in (field for schema in schemas for field in schema):
            sort = sort_of(field, self.folder)
            if present.setdefault(field.name, sort) != sort:
                raise StoreError(
                    "a column changed its type",
                    code="store.schema",
                    where=f"{self.folder} {field.name}",
                    got=str(field.type),
                    allowed="numbers" if present[field.name] == "double" else present[field.name],
                    hint="rename the column in the file, or mend what it holds",
                )
            union.setdefault(field.name, field)
        return pa.schema(list(union.values()))

    def write(self, stem: str, table: pa.Table) -> Written:
        """Write a data file without committing it.

        Parameters
        ----------
        stem : str
            Path of the file inside the table without ending; the hash of what is written is
            appended, which every read compares.
        """
        return self.write_encoded(stem, encoded(table), table.num_rows)

    def write_encoded(self, stem: str, data: bytes | memoryview, rows: int) -> Written:
        """Write the bytes of a Parquet file, without committing it; otherwise as :meth:`write`."""
        name = f"{stem}.{content_hash(data)[:_DIGITS]}.parquet"
        return Written(name, write_bytes(self._path(name)[0], data), rows)

    def commit(self, written: Sequence[Written], schema: pa.Schema) -> int:
        """Add files to the table in one atomic step that a power cut cannot undo.

        Files that are live already are left alone, so a repeated commit changes nothing.

        Parameters
        ----------
        written : sequence of Written
            Files from :meth:`write`.
        schema : pyarrow.Schema
            Their columns as :meth:`accepted` returned them; new ones extend the table.

        Returns
        -------
        int
            Table version after the commit.
        """
        table = self._with_columns(schema)
        for attempt in range(_COMMIT_TRIES):
            live = self._verified(table)
            now_ms = int(time.time() * 1000)
            new = {file.name: file for file in written if file.name not in live}
            actions: list[AddAction | RemoveAction] = [
                AddAction(f.name, f.size, {}, now_ms, True, json.dumps({"numRecords": f.rows})) for f in new.values()
            ]
            if not actions:
                return table.version()
            try:
                return self._written(table, actions, {*live, *new})
            except CommitFailedError:
                time.sleep(0.02 * (attempt + 1))
                table = self._open()
        raise StoreError(
            "another writer kept the table busy",
            code="store.busy",
            where=str(self.folder),
            hint="wait for the other ingest to finish and run this again",
        )

    def _written(self, table: DeltaTable, actions: list[AddAction | RemoveAction], live: Iterable[str]) -> int:
        """Commit actions after which these files are live; sync, and return the version."""
        try:
            table.create_write_transaction(
                actions,
                "append",
                table.schema(),
                [],
                # A commit that met another one is tried again from the start: its hash is of
                # the files that were live before.
                commit_properties=CommitProperties(live_hash(live), max_commit_retries=0),
                post_commithook_properties=_KEEP_LOG,
            )
        except CommitFailedError:
            raise
        except (DeltaError, OSError) as error:
            raise self._refused(error) from error
        return self._synced()

    def _synced(self) -> int:
        version = self.version()
        self.log.committed(version, lambda: self._open().create_checkpoint())
        return version

    def remove(self, names: Sequence[str]) -> int:
        """Take files out of the table; the files themselves stay for time travel."""
        table = self._open()
        live = self._verified(table)
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
        return self._written(table, actions, live - set(names)) if actions else table.version()

    def read_file(self, name: str) -> pa.Table:
        """Read one data file, or one group of its rows; the file is compared with the hash in its name.

        Raises
        ------
        StoreError
            When the file is missing or not the one that was written.
        """
        file, group = _split(name)
        path, digest = self._path(file)

        def verify(data: memoryview) -> None:
            if not content_hash(data).startswith(digest):
                raise OSError("its content is not the one that was written")

        return read_encoded(path, verify, group)[0]

    def intact(self, name: str) -> bool:
        """Return whether a data file is there as it was written."""
        path, digest = self._path(file_of(name))
        return path.is_file() and content_hash(path.read_bytes()).startswith(digest)

    def read(self, names: Iterable[str] | None = None) -> pa.Table:
        """Read files, every live one by default, verified; files that lack a column give nulls."""
        parts = [self.read_file(name) for name in (self.files() if names is None else names)]
        return pa.concat_tables(parts, promote_options="permissive") if parts else pa.table({})

    def sweep(self) -> int:
        """Delete files that no commit ever named, and return how many."""
        if not self.folder.is_dir():
            return 0
        try:
            kept = {path for entry in self.log.entries() for path in added(entry)}
        except (OSError, ValueError, TypeError, KeyError) as error:
            raise self._damaged(str(error)) from error
        stray = [
            path
            for pattern in ("*.parquet", ".*.partial")
            for path in self.folder.rglob(pattern)
            if "_delta_log" not in path.parts and str(path.relative_to(self.folder)) not in kept
        ]
        for path in stray:
            path.unlink(missing_ok=True)
        return len(stray)

    def _path(self, name: str) -> tuple[Path, str]:
        """Return the place of a data file, which must lie inside the table, and its hash."""
        path, named = self.folder / name, _NAME.fullmatch(name)
        if named and path.resolve().is_relative_to(self.folder.resolve()):
            return path, named[1]
        raise StoreError(
            "this is no name of a data file of the table",
            code="store.name",
            where=str(self.folder),
            got=repr(name)[:120],
            hint="restore the lake from a backup",
        )

    def _verified(self, table: DeltaTable) -> set[str]:
        """Return the live files as the newest commit left them."""
        try:
            # Not by pyarrow, which would import pandas to see what it is given.
            live = set(table.get_add_actions()["path"].to_pylist())
            # Not table.history: of an older version it returns the newest entries.
            entry = self.log.entry(table.version()).read_text(encoding="utf-8")
            actions = [json.loads(line) for line in entry.splitlines()]
            hashes = [action["commitInfo"].get(LIVE) for action in actions if "commitInfo" in action]
        except (DeltaError, OSError, ValueError, TypeError, AttributeError) as error:
            raise self._damaged(str(error)) from error
        if hashes == [live_hash(live)[LIVE]]:
            return live
        if self.is_earlier():
            raise StoreError(
                "an earlier version of dtwin made this lake",
                code="store.earlier",
                where=str(self.folder),
                hint="dtwin migrate",
            )
        raise self._damaged("the newest entry does not agree with the files that are live")

    def _open(self, version: int | None = None) -> DeltaTable:
        try:
            return DeltaTable(self.folder, version=version)
        except (TableNotFoundError, DeltaError, OSError, ValueError) as error:
            raise self._damaged(str(error)) from error

    def _damaged(self, got: str) -> StoreError:
        return StoreError(
            "the log of a table is damaged",
            code="store.open",
            where=str(self.log.folder),
            got=got[:200],
            hint="restore _delta_log from a backup; after a power cut: dtwin repair, then ingest "
            "the newest measurements again",
        )

    def _with_columns(self, schema: pa.Schema) -> DeltaTable:
        """Return the newest table, made or extended so that it has these columns."""
        table = self._open() if self.exists() else self._create(schema)
        present = {field.name for field in table.schema().fields}
        fresh = [declared(field, self.folder) for field in schema if field.name not in present]
        if not fresh:
            return table
        properties = CommitProperties(live_hash(self._verified(table)), max_commit_retries=0)
        try:
            table.alter.add_columns(fresh, commit_properties=properties, post_commithook_properties=_KEEP_LOG)
        except CommitFailedError:
            return self._with_columns(schema)
        except (DeltaError, OSError) as error:
            raise self._refused(error) from error
        return self._open()

    def _create(self, schema: pa.Schema) -> DeltaTable:
        fields = [declared(field, self.folder) for field in schema]
        try:
            make_folder(self.folder)
            made = DeltaTable.create(
                self.folder,
                schema=DeltaSchema(fields),
                mode="ignore",
                commit_properties=CommitProperties(live_hash(())),
            )
            sync(self.folder)
            return made
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


def _split(name: str) -> tuple[str, int | None]:
    """Return a file and the group of rows in it that a name means."""
    part = _PART.fullmatch(name)
    return (part[1], int(part[2])) if part else (name, None)
