"""Fetching a machine's bundles from the workbench of another computer: before serving, and while it goes on.

``python -m dtwin.serve.pulling URL MACHINE HOME`` fetches every few seconds until its standard input ends: in a process of
its own, because the loop has no time for it.
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from http.client import HTTPException
from pathlib import Path
from secrets import token_hex
from typing import Any
from urllib.parse import quote, urlsplit

from dtwin.config import Home
from dtwin.errors import DtwinError, GateRefusal, InputError, StoreError
from dtwin.own_address import NoRedirection
from dtwin.processes import running_beside
from dtwin.schema import require_name
from dtwin.serve.bundle_file import parse_json, read_bytes, write_json
from dtwin.serve.delivery import KEY_FILE, LARGEST, MAC, NONCE, answer, install, question, read_key, same

_EVERY_S, _PATIENCE_S, _LONGEST_S, _POLITE = 5.0, 10.0, 60.0, 10
_MAX_NOTE = 10_000


def _pull(url: str, machine: str, home: Home) -> bool:
    """Fetch the bundles and pointers of a machine, put them in force, and return whether anything is new.

    Raises ``InputError`` when address or key are not usable.
    Raises ``StoreError`` when the other computer does not answer.
    Raises ``GateRefusal`` when the answer is not signed with the key, or does not hold; what was in force stays.
    """
    require_name(machine, "the machine")
    key = read_key(home)
    if key is None:
        raise InputError(
            "this host has no key of deliveries",
            code="pull.key",
            where=str(home.root / KEY_FILE),
            hint="dtwin home key at the other computer makes one; copy the file here, for your eyes only",
        )
    content = _asked(url, machine, key)
    new = install(home, machine, content)
    write_json(_note(machine, home), {"from": url, "at": datetime.now(UTC).isoformat("T", "seconds")})
    return new


@contextlib.contextmanager
def pulled(url: str, machine: str, home: Home, announce: Callable[[str], None]) -> Iterator[None]:
    """Fetch a machine's bundles, and go on fetching while the body serves; the last good ones hold while the link is down.

    Raises ``DtwinError`` when nothing can be fetched and nothing was before.
    """
    try:
        _pull(url, machine, home)
        announce(f"bundles of {machine} are those of {url}")
    except DtwinError as error:
        since = _last(machine, home)
        if not since:
            raise
        announce(f"{error.render()}\nserving what was fetched at {since}")
    with running_beside("dtwin.serve.pulling", url, machine, str(home.root)):
        yield


def _asked(url: str, machine: str, key: bytes) -> bytes:
    if urlsplit(url).scheme not in ("http", "https") or not urlsplit(url).hostname:
        raise InputError("the address is not usable", code="pull.url", got=url[:100], allowed="http://HOST:PORT")
    place = f"{url.rstrip('/')}/delivery/{quote(machine, safe='')}"
    nonce = token_hex(16)
    asked = urllib.request.Request(place, headers={NONCE: nonce, MAC: question(key, nonce, machine)})
    try:
        with _limited(time.monotonic() + _LONGEST_S) as opener:
            try:
                with opener.open(asked, timeout=_PATIENCE_S) as reply:
                    signature, content = reply.headers.get(MAC, ""), reply.read(LARGEST + 1)
            except urllib.error.HTTPError as error:
                with error:
                    said = error.read(300).decode(errors="replace").strip()
                raise StoreError(
                    "the other computer delivers nothing",
                    code="pull.refused",
                    where=place,
                    got=f"{error.code} {said}",
                    hint="its key must be this host's, its home must have the machine",
                ) from error
    except (OSError, HTTPException, ValueError) as error:
        raise StoreError(
            "the other computer does not answer", code="pull.away", where=place, got=str(error)[:160]
        ) from error
    if len(content) > LARGEST or not same(signature, answer(key, nonce, content)):
        raise GateRefusal(
            "what was delivered is not signed with the key of this host, or was changed on its way",
            code="pull.signature",
            where=place,
            hint=f"compare {KEY_FILE} of both computers",
        )
    return content


@contextlib.contextmanager
def _limited(until_s: float) -> Iterator[urllib.request.OpenerDirector]:
    """Yield what opens an address, and cut its connection at a time: a server may send a byte now and then for ever.

    Raises ``TimeoutError`` at the end when the time is over: what was read may be whole by chance only.
    """
    sockets: list[socket.socket] = []

    def cut() -> None:
        for connected in sockets:
            with contextlib.suppress(OSError):
                connected.shutdown(socket.SHUT_RDWR)

    class Told(urllib.request.AbstractHTTPHandler):
        def do_open(self, http_class: Any, req: Any, **more: Any) -> Any:
            class Connection(http_class):
                def connect(self) -> None:
                    super().connect()
                    sockets.append(self.sock)

            return super().do_open(Connection, req, **more)

    plain = type("Plain", (Told, urllib.request.HTTPHandler), {})
    secure = type("Secure", (Told, urllib.request.HTTPSHandler), {})
    timer = threading.Timer(until_s - time.monotonic(), cut)
    timer.daemon = True
    timer.start()
    try:
        yield urllib.request.build_opener(NoRedirection, plain, secure)
    except (OSError, HTTPException):
        if time.monotonic() < until_s:
            raise
    finally:
        timer.cancel()
    if time.monotonic() >= until_s:
        raise TimeoutError(f"it was not all there after {_LONGEST_S:g} s")


def _note(machine: str, home: Home) -> Path:
    return home.root / "pulled" / f"{require_name(machine, 'the machine')}.json"


def _last(machine: str, home: Home) -> str:
    """Return when bundles were fetched last; empty when they never were."""
    path = _note(machine, home)
    try:
        return str(parse_json(read_bytes(path, _MAX_NOTE), path)["at"])
    except (DtwinError, KeyError, TypeError):
        return ""


def _main(url: str, machine: str, root: str) -> None:
    os.nice(_POLITE)
    said = ""
    while not select.select([sys.stdin], [], [], _EVERY_S)[0]:
        try:
            _pull(url, machine, Home(Path(root)))
            text = ""
        except DtwinError as error:
            text = error.render()
        if text != said:
            print(text or f"bundles of {machine} are fetched again", file=sys.stderr, flush=True)
        said = text


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        _main(*sys.argv[1:4])
