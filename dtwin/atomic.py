"""Files that are there whole or not at all."""

from __future__ import annotations

import contextlib
import errno
import itertools
import os
import stat
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from threading import get_ident
from typing import Any

import tomli_w

from dtwin.errors import StoreError

_NUMBERS = itertools.count()
"""Of files that are being written: one may be written twice at once."""


@contextlib.contextmanager
def whole_file(path: Path, what: str) -> Iterator[Path]:
    """Yield a name to write to; the file gets its own name once it is complete and on disk.

    ``what``: what it is, for the error message.
    Raises ``StoreError`` when it is the name of no file, or the folder is read-only or full; nothing is left behind, no folder either.
    """
    if not path.name:
        raise StoreError(f"{what} has no name to be written under", code="store.write", where=repr(str(path)))
    partial = path.with_name(f".{path.name}.{os.getpid()}-{get_ident()}-{next(_NUMBERS)}.partial")
    absent = [folder for folder in path.parents if not folder.exists()]
    try:
        if path.parent == Path("/dev") or (path.exists() and not (path.is_file() or path.is_dir())):
            # A file would take its place: of /dev/null or /dev/stdout, for every program.
            raise OSError(errno.EINVAL, "a device or a pipe is no file")
        make_folder(path.parent)
        yield partial
        sync(partial)
        partial.replace(path)
        sync(path.parent)
    except OSError as error:
        raise StoreError(
            f"{what} cannot be written",
            code="store.write",
            where=str(path),
            got=str(error),
            hint="check free space and permissions; nothing was left half-written",
        ) from error
    finally:
        # Also when the work was refused, or interrupted.
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
            for folder in [] if path.exists() else absent:
                folder.rmdir()


def make_folder(folder: Path, *, private: bool = False) -> None:
    """Make a folder and those above it, each entered on disk in the one that holds it.

    What is made ``private`` can be entered by its owner alone.
    """
    missing = [f for f in (folder, *folder.parents) if not f.exists()]
    for absent in reversed(missing):
        absent.mkdir(mode=0o700 if private else 0o777, exist_ok=True)
        sync(absent.parent)
    folder.mkdir(exist_ok=True)


def sync(path: Path) -> None:
    """Wait until a file, or the names in a folder, are on disk: a power cut cannot undo them."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def read_toml(path: Path, max_bytes: int) -> dict[str, Any]:
    """Return what a TOML file states.

    Raises ``OSError`` when it cannot be read; ``ValueError`` when it is larger, no plain file, or no TOML; ``RecursionError``.
    """
    state = path.stat()
    if not stat.S_ISREG(state.st_mode):
        # A pipe would never end.
        raise ValueError("no plain file")
    if state.st_size > max_bytes:
        raise ValueError(f"more than {max_bytes} bytes")
    return tomllib.loads(path.read_text(encoding="utf-8-sig"))


def write_toml(path: Path, content: Mapping[str, Any], what: str) -> Path:
    """Write a TOML file in one step and return its path; arguments as :func:`whole_file`."""
    return write_text(path, tomli_w.dumps(content), what)


def write_text(path: Path, content: str, what: str, *, private: bool = False) -> Path:
    """Write a text file in one step and return its path; arguments as :func:`whole_file`.

    A ``private`` file can be read by its owner alone.
    """
    with whole_file(path, what) as partial:
        if private:
            partial.touch(mode=0o600)
        partial.write_text(content, encoding="utf-8")
    return path


def append_line(path: Path, line: bytes) -> None:
    """Append a line to a log; one that a kill or a full disk cut short is ended first, and spoils no other.

    Raises ``OSError`` when not all of it could be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("ab+", buffering=0) as file:
        cut = False
        if file.seek(0, os.SEEK_END):
            file.seek(-1, os.SEEK_END)
            cut = file.read(1) != b"\n"
        whole = (b"\n" if cut else b"") + line + b"\n"
        if file.write(whole) != len(whole):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
