"""One Delta table whose Parquet files are written and read by us, committed by deltalake."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Iterable, Sequence
from functools import partial
from typing import NamedTuple

import pyarrow as pa
from deltalake import DeltaTable
from deltalake.exceptions import CommitFailedError, DeltaError, TableNotFoundError
from deltalake.schema import Schema as DeltaSchema
from deltalake.transaction import AddAction, CommitProperties, PostCommitHookProperties, RemoveAction

from dtwin.bucket import is_of_store, store_error
from dtwin.errors import StoreError
from dtwin.home_file import Bucket
from dtwin.lake._folders import Place, folder_at
from dtwin.lake._log import LIVE, Log, added, content_hash, declared, entry_of, live_hash, sort_of
from dtwin.lake.parquet import decoded, encoded
from dtwin.processes import within

_COMMIT_TRIES, _OPEN_S = 20, 300
# Log entries stay: repair reads in them which files were ever committed.
_KEEP_LOG = PostCommitHookProperties(cleanup_expired_logs=False)
# Hexadecimal digits of its own hash that the name of a data file ends with.
_DIGITS = 24
_NAME = re.compile(rf"[^\x00]+\.([0-9a-f]{{{_DIGITS}}})\.parquet")
_COLOUR = re.compile(r"\x1b\[[\d;]*m")
# What deltalake says of a table that needs features which it does not have.
_NEWER = re.compile(r"\bunsupported\b|table features", re.I)
# One group of rows of a data file.
_PART = re.compile(r"([^\x00]+\.parquet)#([0-9]{1,6})")


class Moved(Exception):
    """Another writer has changed a table since it was looked at."""


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
    """A Delta table of whole files that are added and removed atomically; its folder comes with the first commit."""

    def __init__(self, place: Place) -> None:
        self.place = place
        self.folder = folder_at(place)
        self.log = Log(self.folder.below("_delta_log"))
        # Of a shared store, where reading the log anew takes ten requests.
        self._kept: DeltaTable | None = None

    def exists(self) -> bool:
        """Tell whether the table was ever written."""
        return self.log.begun()

    def version(self) -> int:
        """Return the current table version; -1 when the table does not exist."""
        return self.log.newest()

    def files(self, version: int | None = None) -> list[str]:
        """Return the relative paths of the live data files of a table version, by default of the newest."""
        if not self.exists() or version == -1:
            return []
        return sorted(self._verified(self._open(version)))

    def is_earlier(self) -> bool:
        """Tell whether no entry of the log has a hash of the live files: version 0.1 wrote none."""
        if not self.exists():
            return False
        try:
            return not any(LIVE in self.log.text(entry) for entry in self.log.entries())
        except (OSError, ValueError):
            return False

    def earlier_files(self) -> list[str]:
        """Return the live files of a table whose log has no hashes, sorted."""
        return sorted(self._open().get_add_actions()["path"].to_pylist()) if self.exists() else []

    def accepted(self, schemas: Iterable[pa.Schema]) -> pa.Schema:
        """Return the columns of several files that are to be written.

        Raises ``StoreError`` when a column that holds numbers would hold text, or the other way round.
        """
        fields = self._open().schema().fields if self.exists() else []
        present = {field.name: str(field.type.type) for field in fields}
        union: dict[str, pa.Field] = {}
        for field in (field for schema in schemas for field in schema):
            sort = sort_of(field, self.place)
            if present.setdefault(field.name, sort) != sort:
                raise StoreError(
                    "a column changed its type",
                    code="store.schema",
                    where=f"{self.place} {field.name}",
                    got=str(field.type),
                    allowed="numbers" if present[field.name] == "double" else present[field.name],
                    hint="rename the column in the file, or mend what it holds",
                )
            union.setdefault(field.name, field)
        return pa.schema(list(union.values()))

    def write(self, stem: str, table: pa.Table) -> Written:
        """Write a data file without committing it.

        ``stem``: path of the file inside the table without ending; the hash of what is written is appended, which every
        read compares.
        """
        return self.write_encoded(stem, encoded(table), table.num_rows)

    def write_encoded(self, stem: str, data: bytes | memoryview, rows: int) -> Written:
        """Write the bytes of a Parquet file, without committing it; otherwise as :meth:`write`."""
        name = f"{stem}.{content_hash(data)[:_DIGITS]}.parquet"
        self._digest(name)
        return Written(name, self.folder.write(name, data), rows)

    def ready(self, schema: pa.Schema) -> int:
        """Make the table, or extend it, so that it has these columns, and return its version."""
        return self._with_columns(schema).version()

    def commit(self, written: Sequence[Written], schema: pa.Schema, *, only_at: int | None = None) -> int:
        """Add files to the table in one atomic step that a power cut cannot undo.

        Files that are live already are left alone, so a repeated commit changes nothing.

        ``written``: files from :meth:`write`.
        ``schema``: their columns as :meth:`accepted` returned them; new ones extend the table.
        ``only_at``: version that the table must be at.
        Returns table version after the commit.
        Raises ``Moved`` when the table is at another version than it must be.
        """
        table = self._with_columns(schema)
        for attempt in range(_COMMIT_TRIES):
            if only_at not in (None, table.version()):
                raise Moved
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
            except CommitFailedError as error:
                if _NEWER.search(str(error)):
                    raise self._newer(str(error)) from error
                time.sleep(0.02 * (attempt + 1))
                table = self._open()
        raise StoreError(
            "another writer kept the table busy",
            code="store.busy",
            where=str(self.place),
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
        return self._synced(table.version() + 1)

    def _synced(self, version: int) -> int:
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

        Raises ``StoreError`` when the file is missing or not the one that was written.
        """
        file, group = _split(name)
        digest = self._digest(file)

        def verify(data: memoryview) -> None:
            if not content_hash(data).startswith(digest):
                raise OSError("its content is not the one that was written")

        return decoded(lambda: self.folder.read(file), f"{self.place}/{file}", verify, group)[0]

    def intact(self, name: str) -> bool:
        """Return whether a data file is there as it was written."""
        file = file_of(name)
        digest = self._digest(file)
        try:
            return content_hash(memoryview(self.folder.read(file))).startswith(digest)
        except OSError:
            return False

    def read(self, names: Iterable[str] | None = None) -> pa.Table:
        """Read files, every live one by default, verified; files that lack a column give nulls."""
        parts = [self.read_file(name) for name in (self.files() if names is None else names)]
        return pa.concat_tables(parts, promote_options="permissive") if parts else pa.table({})

    def sweep(self) -> int:
        """Delete files that no commit ever named, and return how many."""
        if not self.folder.exists():
            return 0
        try:
            kept = {path for entry in self.log.entries() for path in added(self.log.text(entry))}
        except (OSError, ValueError, TypeError, KeyError) as error:
            raise self._damaged(str(error)) from error
        stray = list(self.folder.strays(kept))
        for name in stray:
            self.folder.delete(name)
        return len(stray)

    def _digest(self, name: str) -> str:
        """Return the hash in the name of a data file, which must lie inside the table."""
        named = _NAME.fullmatch(name)
        if named and self.folder.inside(name):
            return named[1]
        raise StoreError(
            "this is no name of a data file of the table",
            code="store.name",
            where=str(self.place),
            got=repr(name)[:120],
            hint="restore the lake from a backup",
        )

    def _verified(self, table: DeltaTable) -> set[str]:
        """Return the live files as the newest commit left them."""
        try:
            # Not by pyarrow, which would import pandas to see what it is given.
            live = set(table.get_add_actions()["path"].to_pylist())
            # Not table.history: of an older version it returns the newest entries.
            entry = self.log.text(entry_of(table.version()))
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
                where=str(self.place),
                hint="dtwin migrate",
            )
        raise self._damaged("the newest entry does not agree with the files that are live")

    def _open(self, version: int | None = None) -> DeltaTable:
        opened = partial(self._opened, self._kept if version is None else None, version)
        try:
            # Of a store the library waits for the end of a list outside of Python, and Ctrl-C for it.
            table = within(_OPEN_S, opened) if isinstance(self.place, Bucket) else opened()
        except TimeoutError as error:
            raise store_error(f"the log was not read within {_OPEN_S} s", str(self.place)) from error
        except (TableNotFoundError, DeltaError, OSError, ValueError) as error:
            raise self._damaged(str(error)) from error
        if version is None and isinstance(self.place, Bucket):
            self._kept = table
        return table

    def _opened(self, kept: DeltaTable | None, version: int | None) -> DeltaTable:
        if kept is None:
            return DeltaTable(str(self.place), version=version, storage_options=self.folder.options)
        kept.update_incremental()
        return kept

    def _damaged(self, got: str) -> StoreError:
        if isinstance(self.place, Bucket) and is_of_store(got):
            return store_error(got, str(self.place))
        if _NEWER.search(got):
            return self._newer(got)
        return StoreError(
            "the log of a table is damaged",
            code="store.open",
            where=str(self.log.folder.place),
            got=got[:200],
            hint="restore _delta_log from a backup; after a power cut: dtwin repair, then ingest "
            "the newest measurements again",
        )

    def _newer(self, got: str) -> StoreError:
        return StoreError(
            "another program made the lake so that this version cannot use it",
            code="store.newer",
            where=str(self.place),
            got=got[:200],
            allowed="tables of Delta as this version of dtwin writes them",
            hint="install the newest dtwin, or restore _delta_log from a backup before it; nothing was lost or committed",
        )

    def _with_columns(self, schema: pa.Schema) -> DeltaTable:
        """Return the newest table, made or extended so that it has these columns."""
        table = self._open() if self.exists() else self._create(schema)
        present = {field.name for field in table.schema().fields}
        fresh = [declared(field, self.place) for field in schema if field.name not in present]
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
        fields = [declared(field, self.place) for field in schema]
        try:
            self.folder.make()
            made = DeltaTable.create(
                str(self.place),
                schema=DeltaSchema(fields),
                mode="ignore",
                commit_properties=CommitProperties(live_hash(())),
                storage_options=self.folder.options,
            )
            self.folder.settle()
            return made
        except CommitFailedError:
            # Another computer was first.
            return self._open()
        except (DeltaError, OSError) as error:
            raise self._refused(error) from error

    def _refused(self, error: Exception) -> StoreError:
        if isinstance(self.place, Bucket):
            return store_error(str(error), str(self.place))
        return StoreError(
            "the lake cannot be written",
            code="store.write",
            where=str(self.place),
            # Its causes stand below each other, in colours.
            got=" ".join(_COLOUR.sub("", str(error)).split())[:200],
            hint="check free space and permissions; nothing was committed",
        )


def _split(name: str) -> tuple[str, int | None]:
    """Return a file and the group of rows in it that a name means."""
    part = _PART.fullmatch(name)
    return (part[1], int(part[2])) if part else (name, None)
