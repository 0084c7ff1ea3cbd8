"""Which versions were withdrawn: a small file that a running session looks at every second."""

from __future__ import annotations

import contextlib
import time

from dtwin.config import Home
from dtwin.errors import DtwinError, InputError
from dtwin.serve._machine_file import machine_folder
from dtwin.serve.sealed import WITHDRAWN, locked, read_sealed, write_sealed

_LOOK_EVERY_S = 1.0
_NO_LIST, _GONE = (0, 0), (-1, -1)


def named_today(state: str) -> str:
    """Return a state as it is called now: homes of before December 2026 hold ``barred`` for ``withdrawn``."""
    return "withdrawn" if state == "barred" else state


def stop_serving(machine: str, home: Home, version: int, reason: str) -> None:
    """Withdraw a version: sessions that serve it release and end, and none begins.

    Raises ``StoreError`` when the file cannot be written.
    """
    folder = machine_folder(machine, home)
    with locked(folder):
        write_sealed(folder, WITHDRAWN, _read(machine, home) | {str(version): reason[:500]})


def serve_again(machine: str, home: Home, version: int) -> None:
    """Take a version off the list, when it was promoted after all; none is no mistake."""
    folder = machine_folder(machine, home)
    if not (folder / WITHDRAWN).exists():
        return
    with locked(folder):
        content = _read(machine, home)
        if content.pop(str(version), None) is not None:
            write_sealed(folder, WITHDRAWN, content)


def withdrawn_why(machine: str, home: Home, version: int) -> str:
    """Return why a version was withdrawn, empty when it was not."""
    return _read(machine, home).get(str(version), "")


class WithdrawalWatch:
    """Asked every tick, looks once a second, whether a version was withdrawn.

    Args:
        machine: As for ``stop_serving``.
        home: As for ``stop_serving``.
        version: As for ``stop_serving``.
    """

    def __init__(self, machine: str, home: Home, version: int) -> None:
        self._machine, self._home, self._version = machine, home, version
        self._file = machine_folder(machine, home) / WITHDRAWN
        self._stamp = self._look()
        self._next_s = time.monotonic() + _LOOK_EVERY_S

    def __call__(self) -> str:
        """Return why, empty while the version may be served."""
        if time.monotonic() < self._next_s:
            return ""
        self._next_s = time.monotonic() + _LOOK_EVERY_S
        stamp = self._look()
        if stamp == self._stamp:
            return ""
        self._stamp = stamp
        if stamp == _GONE:
            return "the folder of its bundles cannot be seen any more, so that nothing could withdraw it"
        try:
            return withdrawn_why(self._machine, self._home, self._version)
        except DtwinError:
            return "the list of withdrawn versions cannot be read"

    def _look(self) -> tuple[int, int]:
        try:
            state = self._file.stat()
        except OSError:
            with contextlib.suppress(OSError):
                if self._file.parent.is_dir():
                    return _NO_LIST
            return _GONE
        return state.st_mtime_ns, state.st_ino


def _read(machine: str, home: Home) -> dict[str, str]:
    folder = machine_folder(machine, home)
    sealed = read_sealed(folder, WITHDRAWN)
    if sealed is None:
        return {}
    if not isinstance(sealed, dict):
        raise InputError(
            "the list of withdrawn versions is malformed", code="withdrawn.file", where=str(folder / WITHDRAWN)
        )
    return {str(key): str(value) for key, value in sealed.items()}
