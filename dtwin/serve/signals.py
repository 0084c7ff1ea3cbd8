"""Ctrl-C, termination and a terminal that is closed as a question that the loop asks, not as an exception in its middle."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Callable, Iterator
from types import FrameType


@contextlib.contextmanager
def stop_on_signals() -> Iterator[Callable[[], bool]]:
    """Yield a function that is true once SIGINT, SIGTERM or SIGHUP has arrived; ``nohup`` goes on without a terminal.

    Must be entered in the main thread; the earlier handlers come back afterwards.
    """
    asked: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        asked.append(number)

    before = {number: signal.signal(number, note) for number in ending_signals()}
    try:
        yield lambda: bool(asked)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def ending_signals() -> tuple[signal.Signals, ...]:
    """Return the signals that ask a process to end; not of a closed terminal, where somebody said that it goes on."""
    deaf = signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    return (signal.SIGINT, signal.SIGTERM, *(() if deaf else (signal.SIGHUP,)))
