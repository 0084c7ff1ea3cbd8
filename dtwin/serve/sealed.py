"""The small files of a machine, under one seal: none can be changed, exchanged or lost unnoticed.

``seal.json`` holds a checksum of each, or null for one that is not there. A writer first allows what the
file is going to be beside what it is, so that a crash at any moment leaves what is valid.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import time
from collections.abc import Iterator, Mapping
from contextvars import ContextVar
from pathlib import Path
from typing import Any

from dtwin.errors import GateRefusal, InputError, StoreError
from dtwin.locks import take
from dtwin.serve._fields import only_fields
from dtwin.serve.bundle_file import json_text, parse_json, read_bytes, write_json

# The last has the name that the first homes gave it: what they withdrew stays withdrawn.
CHAMPION, TRIAL, MACHINE, WITHDRAWN = "champion.json", "trial.json", "machine.json", "barred.json"
_SEAL = "seal.json"
SEALED = (CHAMPION, TRIAL, MACHINE, WITHDRAWN)
_LOCK = "seal.lock"
_MAX_BYTES = 100_000
# A reader may see the file of before and the seal of after.
_LOOKS, _BETWEEN_S = 5, 0.01
_Allowed = dict[str, list[str | None]]
_held: ContextVar[frozenset[Path]] = ContextVar("held", default=frozenset())


def is_sealed(folder: Path) -> bool:
    """Tell whether the files of a machine have a seal; before version 0.2 they had none."""
    return (folder / _SEAL).exists()


def write_sealed(folder: Path, name: str, content: Mapping[str, Any] | None) -> Path:
    """Write one of the files, or take it away, and seal it.

    Whoever changes what is there does both under :func:`locked`.

    Args:
        name: One of ``CHAMPION``, ``TRIAL``, ``MACHINE``, ``WITHDRAWN``.
        content: JSON-ready; None takes the file away.

    Raises:
        StoreError: When the folder cannot be written.
        GateRefusal: When the seal is not whole.
    """
    path = folder / name
    digest = None if content is None else hashlib.sha256(json_text(content).encode()).hexdigest()
    with locked(folder):
        allowed = _allowed(folder)
        if allowed is None:
            allowed = {file: [_digest(folder / file)] for file in SEALED}
        _write_seal(folder, allowed | {name: [*allowed[name][-1:], digest]})
        if content is None:
            _remove(path)
        else:
            write_json(path, content)
        _write_seal(folder, allowed | {name: [digest]})
    return path


def read_sealed(folder: Path, name: str) -> Any:
    """Return the content of one of the files, None when there is rightly none.

    Raises ``GateRefusal`` when it is not what was sealed.
    Raises ``InputError`` when it cannot be read, or is no JSON.
    """
    path = folder / name
    for look in range(_LOOKS):
        raw = read_bytes(path, _MAX_BYTES) if path.exists() else None
        allowed = _allowed(folder)
        if allowed is None:
            if raw is None:
                return None
            raise _broken(folder / _SEAL, "seal.missing", "the seal of a machine's files is missing")
        if (None if raw is None else hashlib.sha256(raw).hexdigest()) in allowed[name]:
            return None if raw is None else parse_json(raw, path)
        if look + 1 < _LOOKS:
            time.sleep(_BETWEEN_S)
    what = "is gone" if raw is None else "is not the one that was written"
    raise _broken(path, "seal.differs", f"a file that serving depends on {what}")


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Let one writer at a time change the files of a machine; a writer may hold it more than once.

    Raises ``StoreError`` when the folder cannot be written.
    """
    if folder in _held.get():
        yield
        return
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle = os.open(folder / _LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    except OSError as error:
        raise StoreError(
            "the machine's folder cannot be written",
            code="bundle.write",
            where=str(folder),
            got=error.strerror or str(error),
        ) from error
    try:
        take(handle, wait=True)
        mine = _held.set(_held.get() | {folder})
        try:
            yield
        finally:
            _held.reset(mine)
    finally:
        os.close(handle)


def _allowed(folder: Path) -> _Allowed | None:
    """Return the checksums that each file may have, the newest last; None without a seal."""
    if not is_sealed(folder):
        return None
    path = folder / _SEAL
    try:
        fields = only_fields(parse_json(read_bytes(path, _MAX_BYTES), path), SEALED, str(path))
    except InputError as error:
        raise _broken(path, "seal.broken", "the seal of a machine's files is not whole") from error
    for digests in fields.values():
        known = isinstance(digests, list) and 1 <= len(digests) <= 2
        if not known or not all(d is None or isinstance(d, str) for d in digests):
            raise _broken(path, "seal.broken", "the seal of a machine's files is not whole")
    return fields


def _write_seal(folder: Path, allowed: _Allowed) -> None:
    write_json(folder / _SEAL, allowed)


def _digest(path: Path) -> str | None:
    return hashlib.sha256(read_bytes(path, _MAX_BYTES)).hexdigest() if path.exists() else None


def _remove(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise StoreError(
            "the file cannot be removed", code="pointer.write", where=str(path), got=error.strerror or str(error)
        ) from error


def _broken(path: Path, code: str, text: str) -> GateRefusal:
    return GateRefusal(
        text,
        code=code,
        where=str(path),
        hint=f"put the folder back from a copy; or look whether champion, machine and withdrawn versions "
        f"are right, remove {_SEAL} there, and dtwin promote again; of a home that an earlier version made: dtwin migrate",
    )
