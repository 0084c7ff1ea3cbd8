"""One server per robot: a lease that ends with the process that holds it."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import socket
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

from dtwin.config import Home
from dtwin.errors import DeviceError, StoreError
from dtwin.locks import take
from dtwin.serve._machine_file import machine_folder

_MAX_NOTE_BYTES, _MOMENT_S = 2000, 0.05


@contextlib.contextmanager
def lease(host: str, machine: str, home: Home) -> Iterator[None]:
    """Hold the robot at an address, and the machine of that name, until the block ends.

    Both are held, because two names for one robot would let two servers write the same
    registers, and two robots under one name would share a log and a model. The kernel drops
    the locks when the process ends, however it ends. They bind the users of one
    ``DTWIN_HOME``; a real controller itself refuses a second writer of the same registers.

    ``host``: address of the robot; names of the same address are the same robot.
    Raises ``DeviceError`` when another process holds one of them.
    Raises ``StoreError`` when the locks cannot be made; without them nothing may move.
    """
    folder = home.root / "locks"
    address = _address(host)
    name = machine_folder(machine, home).name
    # Host names and IPv6 zones hold what file names must not.
    label = hashlib.sha256(address.encode()).hexdigest()[:16]
    with contextlib.ExitStack() as held:
        for path, what in (
            (folder / f"robot-{label}.lock", f"the robot at {address}"),
            (folder / f"machine-{name}.lock", f"the machine {name}"),
        ):
            held.enter_context(_locked(path, what))
        yield


def is_leased(machine: str, home: Home) -> bool:
    """Tell whether a process holds a machine, or may hold it: where that cannot be asked, nothing says that none does.

    It is asked by holding the machine for a moment; who begins meanwhile tries again.
    """
    path = home.root / "locks" / f"machine-{machine_folder(machine, home).name}.lock"
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW)
    except FileNotFoundError:
        return False
    except OSError:
        return True
    try:
        return not take(descriptor)
    finally:
        os.close(descriptor)


@contextlib.contextmanager
def _locked(path: Path, what: str) -> Iterator[None]:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
    except OSError as error:
        raise StoreError(
            "the lease on the robot cannot be taken, so nothing may move",
            code="serve.lease_file",
            where=str(path),
            got=error.strerror or str(error),
            hint="make DTWIN_HOME writable, or look at the model with --shadow",
        ) from error
    try:
        _take(descriptor, path, what)
        yield
    finally:
        # The file stays: removing it would let two processes lock two files of one name.
        os.close(descriptor)


def _take(descriptor: int, path: Path, what: str) -> None:
    if not (take(descriptor) or _later(descriptor)):
        raise DeviceError(
            f"{what} is served already",
            code="serve.lease",
            where=str(path),
            got=_holder(descriptor),
            hint="stop the other server first (Ctrl-C there), or use --shadow",
        )
    note = {"pid": os.getpid(), "since": datetime.now(UTC).isoformat(timespec="seconds")}
    os.ftruncate(descriptor, 0)
    os.pwrite(descriptor, json.dumps(note).encode(), 0)


def _later(descriptor: int) -> bool:
    """Try again: who asks whether a machine is held holds it for a moment."""
    time.sleep(_MOMENT_S)
    return take(descriptor)


def _holder(descriptor: int) -> str:
    try:
        note = json.loads(os.pread(descriptor, _MAX_NOTE_BYTES, 0))
        return f"process {int(note['pid'])} since {str(note['since'])[:40]}"
    except (OSError, ValueError, KeyError, TypeError):
        return "another process"


def _address(host: str) -> str:
    try:
        return str(socket.getaddrinfo(host, None, socket.AF_INET, socket.SOCK_STREAM)[0][4][0])
    except (OSError, UnicodeError):
        return host
