"""What arrives in a folder: told once it stands still.

The folder is looked at again and again, never waited for by the operating system: shares on a
network send no notices. What counts is that size and time of change stay the same from look to
look, by this computer's clock; the clock of the share is never compared with it.
"""

from __future__ import annotations

import hashlib
import os
import stat
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from dtwin.errors import InputError

_CAMPAIGN_FILE = "campaign.toml"
# Of downloads and copies that go on, and of recordings.
_IN_THE_MAKING = (".part", ".partial", ".tmp", ".crdownload", ".arrows", ".intent.json")
Stamp = tuple[tuple[str, int, int], ...]


@dataclass(frozen=True)
class Arrival:
    """A file, or a campaign folder, that has stood still for a while.

    ``stamp``: name, size and time of change of each of its files.
    """

    path: Path
    stamp: Stamp

    @property
    def sha256(self) -> str:
        """Hash of the content of all its files, whatever the place is called."""
        digest = hashlib.sha256()
        for name, _, _ in self.stamp:
            file = self.path / name if name else self.path
            digest.update(os.fsencode(name) + b"\0")
            with file.open("rb") as handle:
                while block := handle.read(1 << 20):
                    digest.update(block)
        return digest.hexdigest()


class Arrivals:
    """Looks at a folder and below it.

    ``folder``: what is looked at. A folder with a ``campaign.toml`` is one thing, every other file for itself.
    ``settle_s``: time for which size and time of change must not move.
    ``wanted``: whether a file by itself, not in a campaign folder, is of interest.
    ``clock``: seconds that never run back.

    Raises ``InputError`` when there is no such folder.
    """

    def __init__(
        self, folder: Path, settle_s: float, wanted: Callable[[Path], bool], clock: Callable[[], float] = time.monotonic
    ) -> None:
        if not folder.is_dir():
            raise InputError(
                "there is no such folder to watch",
                code="watch.folder",
                where=str(folder),
                hint="make the folder, or name another",
            )
        self.folder, self.settle_s = folder, settle_s
        self._wanted, self._clock = wanted, clock
        self._seen: dict[Path, tuple[Stamp, float]] = {}

    def look(self) -> list[Arrival]:
        """Return everything that stands still, sorted by path.

        Raises ``OSError`` when the folder cannot be read now, as when a share is gone.
        """
        now = self._clock()
        present = self.present()
        self._seen = {
            path: self._seen[path] if self._seen.get(path, ((), 0.0))[0] == stamp else (stamp, now)
            for path, stamp in present.items()
        }
        return [
            Arrival(path, stamp)
            for path, (stamp, since_s) in sorted(self._seen.items())
            if now - since_s >= self.settle_s
        ]

    @property
    def moving(self) -> int:
        """How much was seen at the last look and did not stand still yet."""
        now = self._clock()
        return sum(now - since_s < self.settle_s for _, since_s in self._seen.values())

    def present(self) -> dict[Path, Stamp]:
        """Return what is there now, whether or not it stands still."""
        stamps: dict[Path, Stamp] = {}
        for path, is_campaign in _things(self.folder):
            if not is_campaign and not self._wanted(path):
                continue
            stamp = _stamp(path, is_campaign)
            if stamp:
                stamps[path] = stamp
        return stamps


def _things(folder: Path) -> Iterator[tuple[Path, bool]]:
    # A share that is gone raises here, instead of looking like an empty folder.
    next(folder.iterdir(), None)
    for base, folders, files in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        if _CAMPAIGN_FILE in files:
            folders.clear()
            yield Path(base), True
            continue
        for name in sorted(files):
            if not name.startswith(".") and not name.lower().endswith(_IN_THE_MAKING):
                yield Path(base) / name, False


def _stamp(path: Path, is_campaign: bool) -> Stamp:
    """Return what a thing looks like from outside; empty for one that goes or is in the making."""
    if not is_campaign:
        return _of_file(path, "")
    files: list[tuple[str, int, int]] = []
    for file in sorted(path.rglob("*")):
        name = file.relative_to(path).as_posix()
        if name.endswith(_IN_THE_MAKING):
            # Somebody records, or copies, into the folder.
            return ()
        if not any(part.startswith(".") for part in name.split("/")):
            files += _of_file(file, name)
    return tuple(files)


def _of_file(path: Path, name: str) -> Stamp:
    try:
        state = path.stat()
    except OSError:
        return ()
    # A pipe or a device, whatever its name: who opens it may wait, or read, for ever.
    return ((name, state.st_size, state.st_mtime_ns),) if stat.S_ISREG(state.st_mode) else ()
