"""A journal that outlives what it is about: events of a serving session, written by a process of its own.

The loop only puts lines into a pipe, without waiting. The writer appends them to a file, and when the
pipe ends without a goodbye it writes that the loop was killed. A disk that is full costs lines, never
a tick; how many is written as soon as there is room.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import secrets
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol

from dtwin.atomic import append_line
from dtwin.processes import end_child

ENDED, KILLED, GAP = "ended", "killed", "lines_lost"
SERVING, RELEASED, NOT_RELEASED = "serving", "released", "not_released"
LINK_LOST, RECONNECTED = "link_lost", "reconnected"
CLOCK_SET = "clock_set"
"""The clock of this computer went on otherwise than time, ``by_s``: what is told of by the times of lines is before and after."""
_LOOKS_EVERY_S, _SET_BY_S = 0.5, 1.0
_CLOSE_S = 5.0
_PIPE_PROMISE_BYTES = 4096
_BURST, _PER_S = 20.0, 0.5


class Note(Protocol):
    """Takes one event."""

    def __call__(self, event: str, **details: object) -> None:
        """Note an event with its details, JSON-ready."""


def no_journal(event: str, **details: object) -> None:
    """Note nothing."""


class Bucket:
    """Lets a burst through, and then no more than a steady trickle."""

    def __init__(self) -> None:
        self._left, self._last_s = _BURST, math.nan

    def take(self, now_s: float) -> bool:
        """Tell whether one more may go at a monotonic time."""
        if now_s > self._last_s:
            self._left = min(_BURST, self._left + (now_s - self._last_s) * _PER_S)
        self._last_s = now_s
        if self._left < 1.0:
            return False
        self._left -= 1.0
        return True


class Sparing:
    """Notes what may happen at every tick without flooding the journal.

    Of each kind of event 20 lines may come at once, and then one in two seconds; the next line says how many were
    left out before it.

    ``note``: takes the lines that are let through.
    """

    def __init__(self, note: Note) -> None:
        self._note = note
        self._buckets: dict[str, Bucket] = {}
        self._left_out: dict[str, int] = {}

    def __call__(self, event: str, **details: object) -> None:
        """Note an event, or count it."""
        bucket = self._buckets.setdefault(event, Bucket())
        if not bucket.take(time.monotonic()):
            self._left_out[event] = self._left_out.get(event, 0) + 1
            return
        before = self._left_out.pop(event, 0)
        self._note(event, **details, **({"left_out": before} if before else {}))

    def end(self) -> None:
        """Say what was left out and never told."""
        for event, count in self._left_out.items():
            self._note(event, left_out=count)
        self._left_out.clear()


class _Journal:
    """The loop's end of the pipe. ``dropped``: lines that did not fit the pipe."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.dropped = 0
        self.complete = True
        # Sessions of one machine share the file: one that serves and others that look on.
        self._session = secrets.token_hex(4)
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "dtwin.serve._journal", str(path)],
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
        about = {"time": _now(), "event": event, "session": self._session}
        line = json.dumps({**about, **details}).encode() + b"\n"
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
        self.complete = end_child(self._process, _CLOSE_S) == 0 and self.dropped == 0


@contextlib.contextmanager
def journal(path: Path, announce: Callable[[str], None]) -> Iterator[_Journal]:
    """Keep a journal while the block runs; an exception that leaves the block is its reason.

    ``announce``: is told, at the end, when lines could not be written.
    """
    kept = _Journal(path)
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
        self.session: Any = None
        self._alone = threading.Lock()

    def write(self, line: bytes) -> None:
        with self._alone:
            if self.lost:
                gap = json.dumps({"time": _now(), "event": GAP, "lines": self.lost}).encode()
                if self._append(gap):
                    self.lost = 0
            if not self._append(line):
                self.lost += 1
                self.was_lost = True

    def watch_clock(self) -> None:
        """Note whenever the clock is set, for ever."""
        ahead_s = _ahead_s()
        while True:
            time.sleep(_LOOKS_EVERY_S)
            by_s = _ahead_s() - ahead_s
            if abs(by_s) > _SET_BY_S and self.session is not None:
                ahead_s += by_s
                about = {"time": _now(), "event": CLOCK_SET, "session": self.session, "by_s": round(by_s, 3)}
                self.write(json.dumps(about).encode())

    def _append(self, line: bytes) -> bool:
        try:
            append_line(self._path, line.rstrip(b"\n"))
        except OSError:
            return False
        return True


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def _ahead_s() -> float:
    """Return how far the clock is ahead of the time since this computer was started, sleep counted."""
    return time.time() - time.clock_gettime(time.CLOCK_BOOTTIME)


def _main(path: Path) -> int:
    writer, last = _Writer(path), b""
    threading.Thread(target=writer.watch_clock, daemon=True).start()
    for line in sys.stdin.buffer:
        writer.write(line)
        last = line
        writer.session = _field(line, "session")
    if _field(last, "event") != ENDED:
        text = "the serving process died without a word; the machine's own watchdog leads to zero"
        about = {"time": _now(), "event": KILLED, "session": _field(last, "session"), "why": text}
        writer.write(json.dumps(about).encode())
    return 1 if writer.was_lost else 0


def _field(line: bytes, name: str) -> Any:
    try:
        return json.loads(line)[name]
    except (ValueError, KeyError, TypeError):
        return None


if __name__ == "__main__":
    raise SystemExit(_main(Path(sys.argv[1])))
