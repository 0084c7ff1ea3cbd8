"""Fits of several models at a time, in threads."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import CancelledError, Executor, ThreadPoolExecutor
from contextlib import contextmanager
from multiprocessing import parent_process
from threading import Event

from threadpoolctl import threadpool_limits

from dtwin.processes import processors
from dtwin.progress import Progress


@contextmanager
def side_by_side(workers: int | None = None) -> Iterator[tuple[Executor, Progress]]:
    """Give threads to fit models in, and what a long fit calls after every step.

    Linear algebra takes one thread in each: the fits share the processors already. When the caller is interrupted or
    fails, fits that have not begun are dropped and the step ends those that have.

    ``workers``: threads; by default as many as there are processors, one in a process of a pool, which has taken them.
    """
    over = Event()

    def step(_done: int, _of: int, _what: str) -> None:
        if over.is_set():
            raise CancelledError

    with threadpool_limits(1), ThreadPoolExecutor(workers or _free()) as pool:
        try:
            yield pool, step
        except BaseException:
            over.set()
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _free() -> int:
    return processors() if parent_process() is None else 1
