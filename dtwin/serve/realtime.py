"""What the operating system offers a deadline loop, each part used where it is allowed; signals to end as a question that the
loop asks.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import signal
import sys
from collections.abc import Callable, Iterator
from types import FrameType

_LOCK_CURRENT_AND_FUTURE = 3
_PR_SET_TIMERSLACK = 29
_USED = "used"
_WAKE_UP = "/dev/cpu_dma_latency"


@contextlib.contextmanager
def realtime(priority: int = 60, core: int | None = None) -> Iterator[dict[str, str]]:
    """Prepare the process for the loop and undo it afterwards.

    ``priority``: SCHED_FIFO priority; 0 leaves the scheduler alone.
    Yields what each part came to: ``used``, or why not.
    """
    report = {
        "priority": _attempt(lambda: _set_fifo(priority)) if priority else "not asked for",
        "memory_lock": _attempt(lambda: _call("mlockall", _LOCK_CURRENT_AND_FUTURE)),
        "timer_slack": _attempt(lambda: _call("prctl", _PR_SET_TIMERSLACK, 1, 0, 0, 0)),
        "processor": _attempt(lambda: _pin(core)) if core is not None else "not asked for",
    }
    awake = contextlib.ExitStack()
    report["awake"] = _attempt(lambda: _stay_awake(awake)) if priority else "not asked for"
    collecting = gc.isenabled()
    gc.collect()
    gc.freeze()
    gc.disable()
    report["garbage_collection"] = _USED
    try:
        yield report
    finally:
        awake.close()
        if collecting:
            gc.enable()
        gc.unfreeze()
        if report["priority"] == _USED:
            with contextlib.suppress(OSError):
                os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        if report["memory_lock"] == _USED:
            _attempt(lambda: _call("munlockall"))


def _attempt(action: object) -> str:
    try:
        action()  # type: ignore[operator]
    except (OSError, AttributeError, ValueError) as error:
        return f"not available: {getattr(error, 'strerror', None) or error}"
    return _USED


def _set_fifo(priority: int) -> None:
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))


def _stay_awake(until: contextlib.ExitStack) -> None:
    """Ask for no wake-up delay; the kernel keeps the promise while the file stays open.

    On a virtual machine this also keeps the host from taking an idle processor away.
    """
    wish = os.open(_WAKE_UP, os.O_WRONLY)
    until.callback(os.close, wish)
    os.write(wish, (0).to_bytes(4, sys.byteorder))


def _pin(core: int | None) -> None:
    if core is not None:
        os.sched_setaffinity(0, {core})


def _call(name: str, *arguments: int) -> None:
    if not sys.platform.startswith("linux"):
        raise OSError(f"{name} exists on Linux only")
    library = ctypes.CDLL(None, use_errno=True)
    if getattr(library, name)(*(ctypes.c_ulong(a) for a in arguments)) != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


@contextlib.contextmanager
def stop_on_signals(*, from_first_asked: bool = False) -> Iterator[Callable[[], bool]]:
    """Yield a function that is true once SIGINT, SIGTERM or SIGHUP has arrived; ``nohup`` goes on without a terminal.

    Must be entered in the main thread; the earlier handlers come back afterwards.

    ``from_first_asked``: until the function is asked, a signal is a ``KeyboardInterrupt``: nothing is there yet to end in order, and what
    waits for a device is not to be waited for.
    """
    asked: list[int] = []
    noting = not from_first_asked

    def note(number: int, frame: FrameType | None) -> None:
        if not noting:
            raise KeyboardInterrupt
        asked.append(number)

    def was_asked() -> bool:
        nonlocal noting
        noting = True
        return bool(asked)

    before = {number: signal.signal(number, note) for number in ending_signals()}
    try:
        yield was_asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def ending_signals() -> tuple[signal.Signals, ...]:
    """Return the signals that ask a process to end; not of a closed terminal, where somebody said that it goes on."""
    deaf = signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    return (signal.SIGINT, signal.SIGTERM, *(() if deaf else (signal.SIGHUP,)))
