"""How a virtual machine proves to a server of the same user that nothing moves.

The key lies in ``DTWIN_HOME``. Whoever answers a random number with its keyed hash can read that
folder, as ``dtwin simulate`` does and a control on a shop floor does not.
"""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import os
import secrets
from pathlib import Path

from dtwin.config import Home
from dtwin.errors import StoreError

_FILE = "virtual.key"


def new_nonce() -> str:
    """Return a random number that was never asked before."""
    return secrets.token_hex(16)


def proof(home: Home, nonce: str) -> str:
    """Return what only a program of this ``DTWIN_HOME`` can answer to a nonce.

    Args:
        home: Where the key lies; it is made when there is none.

    Raises:
        StoreError: When the key can be neither read nor made.
    """
    path = home.root / _FILE
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(FileExistsError):
            _make(path)
        key = path.read_bytes()
    except OSError as error:
        raise StoreError(
            "the key of virtual machines cannot be used",
            code="virtual.key",
            where=str(path),
            got=error.strerror or str(error),
            hint="make DTWIN_HOME writable",
        ) from error
    return hmac.new(key, nonce.encode(), hashlib.sha256).hexdigest()


def proves(home: Home, nonce: str, answer: object) -> bool:
    """Tell whether an answer to a nonce comes from a program of this ``DTWIN_HOME``."""
    return isinstance(answer, str) and hmac.compare_digest(proof(home, nonce).encode(), answer.encode())


def _make(path: Path) -> None:
    """Put a whole key in place, or none: another process may make one at the same time."""
    part = path.with_name(f"{_FILE}.{os.getpid()}")
    descriptor = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW, 0o600)
    try:
        os.write(descriptor, secrets.token_bytes(32))
    finally:
        os.close(descriptor)
    try:
        os.link(part, path)
    finally:
        part.unlink()
