"""The folder of a Delta table's log: an entry a commit, and summaries of them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from dtwin.atomic import sync

# Who opens a table reads the entries since the last summary of the log, which is written every so many.
_SUMMARY = 10
# Summaries that stay, each as long as the list of live files: the newest, and one of so many commits for time travel.
_NEWEST_KEPT, _KEPT_EVERY = 3, 1000


class Log:
    """The entries ``N.json`` and summaries ``N.checkpoint.parquet`` of a table.

    Entries are never deleted: every version can be read, and repair finds in them which files were ever committed.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def entry(self, version: int) -> Path:
        """Return the place of an entry."""
        return self.folder / f"{version:020d}.json"

    def entries(self) -> list[Path]:
        """Return all entries, the oldest first."""
        return sorted(self.folder.glob("*.json"))

    def newest(self) -> int:
        """Return the newest version, -1 without any."""
        found = self._summed_up()
        if found < 0:
            entries = self.entries()
            return int(entries[-1].stem) if entries else -1
        while self.entry(found + 1).exists():
            found += 1
        return found

    def committed(self, version: int, sum_up: Callable[[], None]) -> None:
        """Bring a new entry to disk, and every so often write a summary and drop those that it replaces.

        ``sum_up``: writes the summary of the newest version.
        """
        sync(self.entry(version))
        if version % _SUMMARY == _SUMMARY - 1:
            sum_up()
            sync(self.folder)
            self.drop_summaries()
        sync(self.folder)

    def drop_summaries(self) -> int:
        """Delete summaries that newer ones replaced, and return how many; every version can still be read."""
        found = sorted(self.folder.glob("*.checkpoint.parquet"))
        old = [path for path in found[:-_NEWEST_KEPT] if (int(path.name[:20]) + 1) % _KEPT_EVERY]
        for path in old:
            path.unlink(missing_ok=True)
        return len(old)

    def set_aside_cut_entry(self) -> str | None:
        """Rename the newest entry when it is empty, as a power cut leaves it; return its name.

        What it would have added is invisible already; its sources can be ingested again.
        """
        entries = self.entries()
        if not entries or entries[-1].stat().st_size:
            return None
        entries[-1].rename(entries[-1].with_suffix(".cut"))
        sync(self.folder)
        return entries[-1].name

    def _summed_up(self) -> int:
        """Return the version of the newest summary, -1 where the log does not say: long logs are not listed for it."""
        try:
            version = int(json.loads((self.folder / "_last_checkpoint").read_bytes())["version"])
            return version if self.entry(version).exists() else -1
        except (OSError, ValueError, TypeError, KeyError, OverflowError):
            return -1
