"""A journal that outlives what it is about: events of a serving session, written by a process of its own.

The loop only puts lines into a pipe, without waiting. The writer appends them to a file, and when the
pipe ends without a goodbye it writes that the loop was killed. A disk that is full costs lines, never
a tick; how many is written as soon as there is room.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol

ENDED, KILLED, GAP = "ended", "killed", "lines_lost"
_CLOSE_S = 5.0
_PIPE_PROMISE_BYTES = 4096


class Note(Protocol):
    """Takes one event."""

    def __call__(self, event: str, **details: object) -> None:
        """Note an event with its details, JSON-ready."""
        ...


def no_journal(event: str, **details: object) -> None:
    """Note nothing."""


class Journal:
    """The loop's end of the pipe.

    Attributes
    ----------
    path : Path
        Where the lines go.
    dropped : int
        Lines that did not fit the pipe.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.dropped = 0
        self.complete = True
        self._process = subprocess.Popen(
            [sys.executable, "-m", "dtwin.serve.journal", str(path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        assert self._process.stdin is not None
        self._pipe = self._process.stdin.fileno()
        os.set_blocking(self._pipe, False)

    @property
    def process_id(self) -> int:
        """Process id of the writer."""
        return self._process.pid

    def note(self, event: str, **details: object) -> None:
        """Hand an event to the writer; one that does not fit the pipe is dropped and counted."""
        line = json.dumps({"time": _now(), "event": event, **details}).encode() + b"\n"
        try:
            # A line below the pipe's promise goes in whole or not at all.
            if len(line) > _PIPE_PROMISE_BYTES:
                raise BlockingIOError
            os.write(self._pipe, line)
        except OSError:
            self.dropped += 1

    def close(self, ended: str, **details: object) -> None:
        """Say goodbye and wait until everything is written; ``complete`` tells whether it was."""
        self.note(ENDED, why=ended, **details)
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):
            self._process.stdin.close()
        try:
            self.complete = self._process.wait(_CLOSE_S) == 0 and self.dropped == 0
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
            self.complete = False


@contextlib.contextmanager
def journal(path: Path, announce: Callable[[str], None]) -> Iterator[Journal]:
    """Keep a journal while the block runs; an exception that leaves the block is its reason.

    Parameters
    ----------
    path : Path
        File to append to.
    announce : callable
        Is told, at the end, when lines could not be written.
    """
    kept = Journal(path)
    try:
        yield kept
    except BaseException as error:
        kept.close(getattr(error, "code", type(error).__name__), said=str(error)[:300])
        raise
    else:
        kept.close("done")
    finally:
        if not kept.complete:
            announce(f"the events {path} are not complete: not every line could be written")


class _Writer:
    """Appends lines, and remembers what could not be written."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.lost = 0
        self.was_lost = False

    def write(self, line: bytes) -> None:
        if self.lost:
            gap = json.dumps({"time": _now(), "event": GAP, "lines": self.lost}).encode()
            if self._append(gap + b"\n"):
                self.lost = 0
        if not self._append(line):
            self.lost += 1
            self.was_lost = True

    def _append(self, line: bytes) -> bool:
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
        except OSError:
            return False
        try:
            return os.write(descriptor, line) == len(line)
        except OSError:
            return False
        finally:
            os.close(descriptor)


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def _main(path: Path) -> int:
    writer, last = _Writer(path), b""
    for line in sys.stdin.buffer:
        writer.write(line)
        last = line
    if _event(last) != ENDED:
        text = "the serving process died without a word; the machine's own watchdog leads to zero"
        writer.write(json.dumps({"time": _now(), "event": KILLED, "why": text}).encode() + b"\n")
    return 1 if writer.was_lost else 0


def _event(line: bytes) -> Any:
    try:
        return json.loads(line)["event"]
    except (ValueError, KeyError, TypeError):
        return None


if __name__ == "__main__":
    raise SystemExit(_main(Path(sys.argv[1])))
