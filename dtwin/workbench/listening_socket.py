"""Where the workbench listens, found before anything heavy is imported."""

from __future__ import annotations

import contextlib
import errno
import socket
from collections.abc import Iterator

from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.locks import locked

_USUAL_PORT = 8765


@contextlib.contextmanager
def only_one(home: Home) -> Iterator[None]:
    """Hold the home's workbench: two would each think the other's work interrupted.

    Raises ``InputError`` when one runs already.
    """
    path = home.made().root / "workbench" / ".lock"
    with locked(path) as mine:
        if not mine:
            raise InputError(
                "a workbench is running for this home already",
                code="ui.running",
                where=str(home.root),
                hint="use the address that it printed, or stop it with Ctrl-C there",
            )
        yield


def listening(host: str, port: int | None) -> socket.socket:
    """Return a socket that listens.

    ``port``: port; without, ``_USUAL_PORT``, or a free one when that is taken.
    Raises ``InputError`` when the address cannot be listened on.
    """
    if port is None:
        try:
            return listening(host, _USUAL_PORT)
        except InputError:
            return listening(host, 0)
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        connection = socket.socket(family, socket.SOCK_STREAM)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        connection.bind((host, port))
        connection.listen(128)
    except OSError as error:
        taken = error.errno == errno.EADDRINUSE
        raise InputError(
            "the port is taken" if taken else "the address cannot be listened on",
            code="ui.port" if taken else "ui.host",
            where=f"{host}:{port}",
            got=error.strerror or str(error),
            hint="dtwin ui without --port takes a free one" if taken else "leave --host out",
        ) from error
    return connection
