"""A lake, byte by byte, at another place: hashed as it is read, and read again there."""

from __future__ import annotations

from collections.abc import Iterator

from dtwin.errors import StoreError
from dtwin.lake._folders import Folder, Place
from dtwin.lake._log import added, content_hash
from dtwin.lake.delta import DeltaFiles
from dtwin.lake.store import TABLES, Lake
from dtwin.progress import Progress, silent

_LAST = "_last_checkpoint"


def copy_lake(source: Place, target: Place, progress: Progress = silent) -> int:
    """Copy a lake with all its versions, and return how many files it has; what is there already is compared.

    Data files come first and the log's entries in their order, so that what is there at any moment is a lake.

    Raises ``StoreError`` when a file is damaged, when another lake lies at the target, or when the source was written
    meanwhile.
    """
    before = Lake(source).versions()
    done = 0
    for name in TABLES:
        table, made = DeltaFiles(_below(source, name)), DeltaFiles(_below(target, name))
        if not table.exists():
            continue
        made.folder.make()
        data, log = list(_data(table)), _log(table)
        for k, file in enumerate(data, start=1):
            # Hashed at this end before it is written, and at the other after it was.
            if not made.intact(file):
                content = _intact(table, file)
                made.folder.write(file, content)
                if not made.intact(file):
                    raise _differs(made.folder, file)
            progress(k, len(data), f"{name}/{file}")
        for entry in log:
            _same(table.log.folder, made.log.folder, entry)
        done += len(data) + len(log)
    if Lake(source).versions() != before:
        raise StoreError(
            "the lake was written while it was copied",
            code="move.written",
            where=str(source),
            hint="run this again when nobody ingests; what is copied already is not copied again",
        )
    return done


def _below(place: Place, name: str) -> Place:
    return place / name


def _data(table: DeltaFiles) -> Iterator[str]:
    """Yield the data files that any entry of the log named and that are there; live ones must be."""
    live = set(table.files())
    named = {path for entry in table.log.entries() for path in added(table.log.text(entry))}
    for file in sorted(live | named):
        if file in live or table.folder.has(file):
            yield file


def _log(table: DeltaFiles) -> list[str]:
    folder = table.log.folder
    last = [_LAST] if folder.has(_LAST) else []
    return [*folder.names(".json"), *folder.names(".checkpoint.parquet"), *last]


def _intact(table: DeltaFiles, file: str) -> memoryview:
    if not table.intact(file):
        raise StoreError(
            "a data file is missing or damaged",
            code="store.damaged",
            where=f"{table.place}/{file}",
            hint="restore the file from a backup, or ingest its source again",
        )
    return memoryview(table.folder.read(file))


def _same(source: Folder, target: Folder, name: str) -> None:
    """Copy a file of the log; one that is there must be the same, but for the note of the newest summary."""
    content = memoryview(source.read(name))
    if name != _LAST and target.has(name):
        if not name.endswith(".json") or bytes(target.read(name)) == bytes(content):
            return
        raise StoreError(
            "another lake lies there",
            code="move.other",
            where=f"{target.place}/{name}",
            hint="name a place that is empty",
        )
    target.write(name, content)
    if content_hash(memoryview(target.read(name))) != content_hash(content):
        raise _differs(target, name)


def _differs(folder: Folder, name: str) -> StoreError:
    return StoreError(
        "what was written is not what is read there",
        code="move.differs",
        where=f"{folder.place}/{name}",
        hint="run this again; the home stays where it is",
    )
