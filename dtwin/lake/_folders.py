"""Where the files of a table lie: in a folder here, or in one of a shared store, and how writers wait for each other."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Protocol

import pyarrow as pa

from dtwin.atomic import make_folder, sync
from dtwin.bucket import Objects, delta_options
from dtwin.errors import StoreError
from dtwin.home_file import Bucket
from dtwin.lake.parquet import content_of, write_bytes
from dtwin.locks import take

Place = Path | Bucket
# A data file of a shared store that no commit names may be one of another computer that is about to name it.
_STRAY_FOR = timedelta(days=1)


class Folder(Protocol):
    """A folder with whole files in it; what is missing or cannot be read raises OSError, or StoreError."""

    place: Place

    @property
    def options(self) -> dict[str, str] | None:
        """What the library of Delta tables is told besides the address."""

    def below(self, name: str) -> Folder:
        """Return a folder in it."""

    def exists(self) -> bool:
        """Tell whether there is anything."""

    def has(self, name: str) -> bool:
        """Tell whether there is such a file."""

    def inside(self, name: str) -> bool:
        """Tell whether a name leads to a file of the folder."""

    def read(self, name: str) -> pa.Buffer:
        """Return the content of a file, in memory of Arrow."""

    def write(self, name: str, data: bytes | memoryview) -> int:
        """Write a file, whole or not at all, and return its size."""

    def names(self, ending: str, after: str = "") -> list[str]:
        """Return the files right in the folder with this ending, sorted; those after a name only."""

    def delete(self, name: str) -> None:
        """Delete a file; one that is not there is no mistake."""

    def settle(self, name: str = "") -> None:
        """Wait until a file, or the names in the folder, are on disk."""

    def make(self) -> None:
        """Make the folder."""

    def strays(self, kept: Collection[str]) -> Iterator[str]:
        """Yield the files at any depth, without the log's, that are not kept and that nobody is about to keep."""


class _LocalFolder:
    """A folder of this computer."""

    options = None

    def __init__(self, place: Path) -> None:
        self.place: Place = place
        self._path = place

    def below(self, name: str) -> _LocalFolder:
        """Return a folder in it."""
        return _LocalFolder(self._path / name)

    def exists(self) -> bool:
        """Tell whether it is there."""
        return self._path.is_dir()

    def has(self, name: str) -> bool:
        """Tell whether there is such a file."""
        return (self._path / name).is_file()

    def inside(self, name: str) -> bool:
        """Tell whether a name leads to a file of the folder, links followed."""
        return (self._path / name).resolve().is_relative_to(self._path.resolve())

    def read(self, name: str) -> pa.Buffer:
        """Return the content of a file, in memory of Arrow."""
        return content_of(self._path / name)

    def write(self, name: str, data: bytes | memoryview) -> int:
        """Write a file and bring it to disk."""
        try:
            return write_bytes(self._path / name, data)
        except StoreError as error:
            error.hint = "make space and run this again; dtwin repair frees what was written and is not in the lake yet"
            raise

    def names(self, ending: str, after: str = "") -> list[str]:
        """Return the files with this ending, sorted."""
        return sorted(path.name for path in self._path.glob(f"*{ending}") if path.name > after)

    def delete(self, name: str) -> None:
        """Delete a file; one that is not there is no mistake."""
        (self._path / name).unlink(missing_ok=True)

    def settle(self, name: str = "") -> None:
        """Wait until a file, or the names in the folder, are on disk."""
        sync(self._path / name if name else self._path)

    def make(self) -> None:
        """Make the folder."""
        make_folder(self._path)

    def strays(self, kept: Collection[str]) -> Iterator[str]:
        """Yield the data files that are not kept, and what a killed process was writing."""
        for pattern in ("*.parquet", ".*.partial"):
            for path in self._path.rglob(pattern):
                name = path.relative_to(self._path).as_posix()
                if "_delta_log" not in path.parts and name not in kept:
                    yield name


class _SharedFolder:
    """A folder of a shared store: a file is there whole as soon as the store has taken it."""

    def __init__(self, place: Bucket) -> None:
        self.place: Place = place
        self._bucket = place
        self._objects = Objects(place)
        # Runs of a campaign lie in one file, and are read one by one.
        self._last: tuple[str, pa.Buffer] | None = None

    @property
    def options(self) -> dict[str, str]:
        """Address and patience; keys come from the environment."""
        return delta_options(self._bucket)

    def below(self, name: str) -> _SharedFolder:
        """Return a folder in it."""
        return _SharedFolder(self._bucket / name)

    def exists(self) -> bool:
        """Tell whether there is anything: the first entry of a log is never deleted."""
        return self._objects.has(f"{0:020d}.json") if self._bucket.below.endswith("_delta_log") else True

    def has(self, name: str) -> bool:
        """Tell whether there is such an object."""
        return self._objects.has(name)

    def inside(self, name: str) -> bool:
        """Tell whether a name stays below the folder."""
        parts = name.split("/")
        return not name.startswith("/") and ".." not in parts and "." not in parts and "" not in parts

    def read(self, name: str) -> pa.Buffer:
        """Return the content of an object, in memory of Arrow as above."""
        last = self._last
        if last is not None and last[0] == name:
            return last[1]
        sink = pa.BufferOutputStream()
        sink.write(self._objects.read(name))
        content = sink.getvalue()
        if name.endswith(".parquet"):
            self._last = name, content
        return content

    def write(self, name: str, data: bytes | memoryview) -> int:
        """Write an object."""
        self._last = None
        self._objects.put(name, data)
        return len(data)

    def names(self, ending: str, after: str = "") -> list[str]:
        """Return the objects right in the folder with this ending, sorted."""
        names = [stored.name for stored in self._objects.list(after=after)]
        return [name for name in names if name.endswith(ending) and "/" not in name and name > after]

    def delete(self, name: str) -> None:
        """Delete an object."""
        self._objects.delete([name])

    def settle(self, name: str = "") -> None:
        """Do nothing: what the store has taken is kept."""

    def make(self) -> None:
        """Try the store before anything is written to it: it has no folders."""
        self._objects.probe()

    def strays(self, kept: Collection[str]) -> Iterator[str]:
        """Yield the data files that are not kept and are older than a day, by the clock of the store."""
        objects = self._objects.list()
        newest = max((stored.changed for stored in objects), default=datetime.now(UTC))
        for stored in objects:
            mine = stored.name.endswith(".parquet") and "_delta_log/" not in stored.name and stored.name not in kept
            if mine and newest - stored.changed > _STRAY_FOR:
                yield stored.name


def folder_at(place: Place) -> Folder:
    """Return the folder at a place."""
    return _SharedFolder(place) if isinstance(place, Bucket) else _LocalFolder(place)


@contextmanager
def writing(place: Place, name: str, *, shared: bool = False) -> Iterator[None]:
    """Hold a lock of a lake.

    On a shared store there is none: a commit there is a write with a condition, and who comes second begins anew.
    That the store keeps to conditions is tried instead.

    Raises ``StoreError`` when the lake cannot be written.
    """
    if isinstance(place, Bucket):
        Objects(place).probe()
        yield
        return
    try:
        make_folder(place, private=True)
        handle = (place / name).open("w")
    except OSError as error:
        raise StoreError(
            "the lake cannot be written",
            code="store.write",
            where=str(place),
            got=str(error),
            hint="check free space and permissions; nothing was committed",
        ) from error
    with handle:
        take(handle, shared=shared, wait=True)
        yield
