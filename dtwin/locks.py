"""Locks between processes; the system lets go of them when their holder ends, however it ends."""

from __future__ import annotations

import contextlib
import fcntl
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from dtwin.errors import StoreError


def take(file: int | IO[Any], *, shared: bool = False, wait: bool = False) -> bool:
    """Lock an open file until it is closed; without ``wait``, return False while another holds it.

    Many may hold a ``shared`` lock, but not while one holds it alone.
    """
    try:
        fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        return False
    return True


@contextlib.contextmanager
def locked(path: Path, *, wait: bool = False) -> Iterator[bool]:
    """Hold a lock alone and yield True; without ``wait``, yield False while another holds it.

    Raises ``StoreError`` when the file cannot be made.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle = path.open("a")
    except OSError as error:
        raise StoreError(
            "a lock cannot be made",
            code="store.write",
            where=str(path),
            got=error.strerror or str(error),
            hint="check free space and permissions",
        ) from error
    with handle:
        yield take(handle, wait=wait)
