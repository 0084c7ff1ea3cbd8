"""Where the work of a fleet is done, behind the interface of :mod:`concurrent.futures`."""

from __future__ import annotations

import logging
import multiprocessing
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

from dtwin.errors import InputError, StoreError
from dtwin.own_address import names_this_computer
from dtwin.processors import processors

_FORMS = "local, dask://host:port on this computer, dask+tls://host:port"
_CONNECT_S = 10


@dataclass(frozen=True)
class Engine:
    """An executor and how much work it is given at once.

    ``slots``: units that are under way at most; what is not under way costs no memory.
    """

    executor: Executor
    slots: int


class _InLine(Executor):
    """Does a call where it is submitted."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Return a future that is done."""
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


def require_engine(on: str, workers: int | None) -> str:
    """Return the address of a Dask scheduler as Dask writes it, empty for ``local``.

    Raises ``InputError`` when it is neither, or would be asked unsafely.
    """
    if on == "local":
        return ""
    address = urlsplit(on)
    if address.scheme not in ("dask", "dask+tls") or not address.netloc or address.path:
        raise InputError("no such engine", code="fleet.engine", where="--on", got=on, allowed=_FORMS)
    if workers is not None:
        raise InputError(
            "the scheduler knows its workers",
            code="fleet.workers",
            where="--workers",
            got=str(workers),
            hint="leave it out",
        )
    if address.scheme == "dask" and not names_this_computer(address.netloc):
        raise InputError(
            "who reaches a Dask scheduler can run code on its workers, and this one is asked without TLS",
            code="fleet.insecure",
            where="--on",
            got=on,
            allowed=_FORMS,
            hint="give scheduler and workers certificates, and use dask+tls://",
        )
    return f"{'tls' if address.scheme == 'dask+tls' else 'tcp'}://{address.netloc}"


@contextmanager
def engine(on: str = "local", workers: int | None = None) -> Iterator[Engine]:
    """Start an engine, and stop it at the end; work that has not begun by then is given up.

    ``on``: ``local``, or the address of a Dask scheduler: ``dask://host:port`` on this computer,
    ``dask+tls://host:port`` with the certificates that Dask's own configuration names.
    ``workers``: processes of ``local``; 1 works in line. By default one for each processor.
    Raises ``InputError`` as :func:`require_engine`.
    Raises ``StoreError`` when no scheduler answers, or it has no worker.
    """
    scheduler = require_engine(on, workers)
    with _dask(scheduler) if scheduler else _local(workers or processors()) as found:
        yield found


@contextmanager
def _local(workers: int) -> Iterator[Engine]:
    if workers == 1:
        yield Engine(_InLine(), 1)
        return
    # Not forked: a copy of a process with threads may hold a lock that nobody opens again.
    pool = ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"))
    try:
        yield Engine(pool, 2 * workers)
    finally:
        pool.shutdown(cancel_futures=True)


@contextmanager
def _dask(address: str) -> Iterator[Engine]:
    from distributed import Client

    # What it logs of a lost connection is said by the error that we raise.
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
    try:
        client = Client(address, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, TimeoutError) as error:
        raise StoreError(
            "no scheduler answers", code="fleet.scheduler", where=address, got=str(error)[:120], hint="dask scheduler"
        ) from error
    with client:
        workers = sum(client.nthreads().values())
        if not workers:
            raise StoreError(
                "the scheduler has no worker", code="fleet.worker", where=address, hint=f"dask worker {address}"
            )
        # Not pure: a result is asked for again only when it is wanted again.
        yield Engine(client.get_executor(pure=False), 2 * workers)
