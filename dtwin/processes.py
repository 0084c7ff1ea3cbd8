"""Which process did something, whether it is still there, what memory it holds, and processes beside this one."""

from __future__ import annotations

import ctypes
import hashlib
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from contextvars import copy_context
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

_Returned = TypeVar("_Returned")
_ENDED = "ZX"
_SET_SIGNAL_OF_PARENTS_END = 1


def process(pid: int | None = None) -> str:
    """Return host, number and start of a process, this one by default.

    The start tells a process from a later one with the same number; it is 0 for one that is gone, or that ended and nobody
    asks for its exit code, as in a container without an init.
    """
    number = os.getpid() if pid is None else pid
    try:
        stat = Path(f"/proc/{number}/stat").read_text(encoding="utf-8")
        fields = stat.rpartition(")")[2].split()
        start = "0" if fields[0] in _ENDED else fields[19]
    except (OSError, IndexError):
        start = "0"
    return f"{socket.gethostname().replace(' ', '-')}-{_computer()} {number} {start}"


@cache
def _computer() -> str:
    """Return what tells this computer from another of the same name: of its installation, else of its start."""
    for place in ("/etc/machine-id", "/proc/sys/kernel/random/boot_id"):
        with suppress(OSError):
            if told := Path(place).read_bytes().strip():
                # It is nobody's business as it is.
                return hashlib.sha256(told).hexdigest()[:8]
    return ""


def is_gone(stated: str) -> bool:
    """Return whether a process of this computer, as :func:`process` stated it, has ended.

    Of another computer, or of none, nothing is known: False.
    """
    host, _, rest = stated.partition(" ")
    number = rest.partition(" ")[0]
    if host != process(0).partition(" ")[0] or not number.isdigit():
        return False
    return process(int(number)) != stated


def end_child(process: subprocess.Popen[Any], patience_s: float) -> int | None:
    """Close the input of a child, which tells it to end, and wait; return its exit code, None when it had to be killed."""
    with suppress(OSError):
        if process.stdin is not None:
            process.stdin.close()
    try:
        return process.wait(patience_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        return None


@contextmanager
def running_beside(module: str, *arguments: str) -> Iterator[None]:
    """Run a module in a process of its own, whose standard input ends when this process does, however it ends."""
    command = [sys.executable, "-P", "-m", module, *arguments]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL) as child:
        try:
            yield
        finally:
            child.terminate()


def end_with(parent: int) -> None:
    """End this process, a worker of a pool, when the thread of ``parent`` that began it ends, however that ends: a pool's worker waits for ever."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(_SET_SIGNAL_OF_PARENTS_END, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:
        os._exit(1)


def interruptible(call: Callable[[], _Returned]) -> _Returned:
    """Return what a call returns; Ctrl-C does not wait for the end of one that waits outside of Python."""
    return call() if threading.current_thread() is not threading.main_thread() else within(None, call)


def within(patience_s: float | None, call: Callable[[], _Returned]) -> _Returned:
    """Return what a call returns, in a thread of its own; raises ``TimeoutError`` when it takes longer, which it may go on to do."""
    done: Future[_Returned] = Future()

    def work() -> None:
        try:
            done.set_result(call())
        except BaseException as error:
            done.set_exception(error)

    threading.Thread(target=copy_context().run, args=(work,), daemon=True).start()
    return done.result(patience_s)


def processors() -> int:
    """Return how many processors this process may use."""
    # Only Linux says which ones a process is held to.
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def give_back_memory() -> None:
    """Give what a long computation has left free to the system.

    The allocator of Linux keeps it otherwise: what little stays beside it pins it to the process.
    """
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
