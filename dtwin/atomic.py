"""Files that are there whole or not at all."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from dtwin.errors import StoreError


@contextlib.contextmanager
def whole_file(path: Path, what: str) -> Iterator[Path]:
    """Yield a name to write to; the file gets its own name once it is complete and on disk.

    Parameters
    ----------
    path : Path
        File to write or replace; its folder is created.
    what : str
        What it is, for the error message.

    Raises
    ------
    StoreError
        When the folder is read-only or full; nothing is left behind.
    """
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield partial
        with partial.open("rb") as written:
            os.fsync(written.fileno())
        partial.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
        raise StoreError(
            f"{what} cannot be written",
            code="store.write",
            where=str(path),
            got=str(error),
            hint="check free space and permissions; nothing was left half-written",
        ) from error


def write_text(path: Path, content: str, what: str) -> Path:
    """Write a text file in one step and return its path; arguments as :func:`whole_file`."""
    with whole_file(path, what) as partial:
        partial.write_text(content, encoding="utf-8")
    return path
