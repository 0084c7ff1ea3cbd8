"""Text files that are there whole or not at all."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from dtwin.errors import StoreError


def write_text(path: Path, content: str, what: str) -> Path:
    """Write a file in one step and return its path.

    Parameters
    ----------
    path : Path
        File to write or replace; its folder is created.
    content : str
        What it holds.
    what : str
        What it is, for the error message.

    Raises
    ------
    StoreError
        When it cannot be written; nothing is left behind.
    """
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.write_text(content, encoding="utf-8")
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
    return path
