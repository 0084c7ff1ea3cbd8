"""The folder of a Delta table's log: an entry a commit, summaries of them, and what they say: columns, live files, hashes."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import pyarrow as pa
from blake3 import blake3
from deltalake.schema import Field, PrimitiveType

from dtwin.errors import StoreError
from dtwin.lake._folders import Folder
from dtwin.lake.parquet import NUMBERS
from dtwin.units import unit_of

# Who opens a table reads the entries since the last summary of the log, which is written every so many.
_SUMMARY = 10
# Summaries that stay, each as long as the list of live files: the newest, and one of so many commits for time travel.
_NEWEST_KEPT, _KEPT_EVERY = 3, 1000


class Log:
    """The entries ``N.json`` and summaries ``N.checkpoint.parquet`` of a table.

    Entries are never deleted: every version can be read, and repair finds in them which files were ever committed.
    """

    def __init__(self, folder: Folder) -> None:
        self.folder = folder

    def begun(self) -> bool:
        """Tell whether there is an entry: a first commit that a kill or a full disk ended leaves the folder alone."""
        return self.folder.has(entry_of(0)) or (isinstance(self.folder.place, Path) and bool(self.entries()))

    def entries(self) -> list[str]:
        """Return the names of all entries, the oldest first."""
        return self.folder.names(".json")

    def text(self, entry: str) -> str:
        """Return the content of an entry."""
        return self.folder.read(entry).to_pybytes().decode()

    def newest(self) -> int:
        """Return the newest version, -1 without any."""
        if isinstance(self.folder.place, Path):
            return self._newest_here()
        # Each question to a store takes as long as a list.
        after = max(self._summed_up(), 0)
        entries = self.folder.names(".json", after=entry_of(after - 1) if after else "")
        return int(entries[-1].removesuffix(".json")) if entries else -1

    def committed(self, version: int, sum_up: Callable[[], None]) -> None:
        """Bring a new entry to disk, and every so often write a summary and drop those that it replaces.

        ``sum_up``: writes the summary of the newest version.
        """
        self.folder.settle(entry_of(version))
        if version % _SUMMARY == _SUMMARY - 1:
            sum_up()
            self.folder.settle()
            self.drop_summaries()
        self.folder.settle()

    def drop_summaries(self) -> int:
        """Delete summaries that newer ones replaced, and return how many; every version can still be read."""
        summaries = self.folder.names(".checkpoint.parquet")
        old = [name for name in summaries[:-_NEWEST_KEPT] if (int(name[:20]) + 1) % _KEPT_EVERY]
        for name in old:
            self.folder.delete(name)
        return len(old)

    def set_aside_cut_entry(self) -> str | None:
        """Rename the newest entry when it is empty, as a power cut leaves it; return its name.

        What it would have added is invisible already; its sources can be ingested again. A shared store
        takes an entry as a whole.
        """
        place = self.folder.place
        entries = self.entries() if isinstance(place, Path) else []
        if not entries or not isinstance(place, Path) or (place / entries[-1]).stat().st_size:
            return None
        cut = place / entries[-1]
        cut.rename(cut.with_suffix(".cut"))
        self.folder.settle()
        return cut.name

    def _newest_here(self) -> int:
        newest = self._summed_up()
        if newest < 0:
            entries = self.entries()
            return int(entries[-1].removesuffix(".json")) if entries else -1
        while self.folder.has(entry_of(newest + 1)):
            newest += 1
        return newest

    def _summed_up(self) -> int:
        """Return the version of the newest summary, -1 where the log does not say: long logs are not listed for it."""
        try:
            version = int(json.loads(self.folder.read("_last_checkpoint").to_pybytes())["version"])
            return version if self.folder.has(entry_of(version)) else -1
        except (OSError, ValueError, TypeError, KeyError, OverflowError):
            return -1


def entry_of(version: int) -> str:
    """Return the name of an entry."""
    return f"{version:020d}.json"


LIVE = "dtwin.live_blake3"
"""Under this name every commit carries a hash of the files that are live after it."""

# A column is declared as the widest type of its sort; each file keeps the type it was
# written with, and readers cast. So no campaign fixes the width of a column for the others.
_SORTS = {pa.string(): "string", pa.bool_(): "boolean", **dict.fromkeys(NUMBERS, "double")}


def live_hash(names: Iterable[str]) -> dict[str, str]:
    """Return the custom entry of a commit after which these files are live."""
    return {LIVE: content_hash("\n".join(sorted(names)).encode())}


def content_hash(data: bytes | memoryview) -> str:
    """Return the BLAKE3 hash of bytes, in hexadecimal."""
    return str(blake3(data).hexdigest())


def added(entry: str) -> Iterator[str]:
    """Yield the files that a log entry adds."""
    for line in entry.splitlines():
        action = json.loads(line)
        if "add" in action:
            yield str(action["add"]["path"])


def sort_of(field: pa.Field, folder: object) -> str:
    """Return the Delta type that a column is declared as."""
    if field.type not in _SORTS:
        raise StoreError(
            "a column has a type that the lake does not keep",
            code="store.schema",
            where=f"{folder} {field.name}",
            got=str(field.type),
            allowed=", ".join(map(str, _SORTS)),
        )
    return _SORTS[field.type]


def declared(field: pa.Field, folder: object) -> Field:
    """Return the Delta field of a column, with its unit."""
    unit = unit_of(field.name)
    metadata = {} if unit is None else {"unit": unit}
    return Field(field.name, PrimitiveType(sort_of(field, folder)), nullable=True, metadata=metadata)
