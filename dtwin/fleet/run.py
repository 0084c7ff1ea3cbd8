"""Do a job for many machines on an engine, keep what comes back, and say what failed; where the engine does the work."""

from __future__ import annotations

import logging
import multiprocessing
import os
from collections.abc import Callable, Collection, Iterator, Mapping
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any
from urllib.parse import urlsplit

from dtwin.config import Home
from dtwin.errors import DtwinError, InputError, Interrupted, StoreError
from dtwin.fleet.jobs import Job, Unit
from dtwin.locks import locked
from dtwin.own_address import names_this_computer
from dtwin.processes import end_with, processors
from dtwin.progress import Progress, silent

_TRIES = 3


@dataclass
class FleetRun:
    """What became of a job.

    ``done``: what is said of each unit that was worked on and kept, by name.
    ``failed``: the errors of others, as :meth:`dtwin.errors.DtwinError.as_dict` gives them.
    ``passed``: what there was nothing to do about, and why.
    """

    job: str
    on: str
    done: dict[str, dict[str, Any]] = field(default_factory=dict)
    failed: dict[str, Mapping[str, str]] = field(default_factory=dict)
    passed: dict[str, str] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return vars(self) | {"failed": {name: dict(error) for name, error in self.failed.items()}}


def run_fleet(
    home: Home,
    job: Job,
    machines: Collection[str] = (),
    *,
    on: str = "local",
    workers: int | None = None,
    seed: int = 0,
    progress: Progress = silent,
    into: FleetRun | None = None,
) -> FleetRun:
    """Do a job for machines, and keep every result as it comes.

    Units that were kept are not there the next time: a job that was interrupted goes on. What is kept does not
    depend on the engine.

    ``machines``: all of the home without names.
    ``on``, ``workers``: as for :func:`engine`.
    ``into``: what is filled and returned: it holds what was done also where an error ends the job.
    Raises ``StoreError`` when another process does the same job in this home, or the scheduler died.
    """
    _require_engine(on, workers)
    with locked(home.root / "locks" / f"fleet-{job.name}.lock") as mine:
        if not mine:
            raise StoreError(
                "another process does the same for this home",
                code="store.busy",
                where=str(home.root),
                got=f"fleet {job.name}",
                hint="wait for it, or stop it: what it did is kept",
            )
        run = into or FleetRun(job.name, on)
        units, run.passed = job.units(home, machines)
        alone, tries = False, 0
        while todo := [unit for unit in units if unit.name not in run.done and unit.name not in run.failed]:
            tries += 1
            try:
                with engine(on, workers) as at:
                    for unit, future in _answers(replace(at, slots=1) if alone else at, home, job, todo, seed):
                        _take(run, home, job, unit, future)
                        progress(len(run.done) + len(run.failed), len(units), unit.name)
            except BrokenExecutor:
                # A process died: one unit at a time shows with which.
                if alone:
                    culprit = next(unit for unit in todo if unit.name not in run.done and unit.name not in run.failed)
                    run.failed[culprit.name] = _killed(culprit).as_dict()
                alone = True
            except (CancelledError, StoreError) as error:
                # The scheduler died. What is not kept is asked for again, when there is one again.
                if isinstance(error, StoreError) and tries == 1:
                    raise
                if isinstance(error, StoreError) or tries == _TRIES:
                    raise _died(run, units, on) from error
            except KeyboardInterrupt as error:
                raise _stopped(run, units) from error
        return run


def _answers(at: _Engine, home: Home, job: Job, units: list[Unit], seed: int) -> Iterator[tuple[Unit, Future[Any]]]:
    """Yield units and their futures as they end; a few are under way at once."""
    rest = iter(units)
    under_way: dict[Future[Any], Unit] = {}
    while True:
        while len(under_way) < at.slots and (unit := next(rest, None)) is not None:
            under_way[at.executor.submit(job.work, str(home.root), unit, seed)] = unit
        if not under_way:
            return
        for future in _ended(at, under_way):
            yield under_way.pop(future), future


def _ended(at: _Engine, under_way: Collection[Future[Any]]) -> set[Future[Any]]:
    """Wait until a future ends, as long as somebody works."""
    nobody = 0
    while not (ended := wait(under_way, _LOOK_S, FIRST_COMPLETED).done):
        nobody = 0 if at.workers() else nobody + 1
        if nobody == _LOOKS:
            raise StoreError(
                "the scheduler has no worker any more, or does not answer",
                code="fleet.worker",
                got=f"nobody for {_LOOK_S * _LOOKS:g} s",
                hint="what was done is kept: start a worker, and give the same command again",
            )
    return ended


def _take(run: FleetRun, home: Home, job: Job, unit: Unit, future: Future[Any]) -> None:
    """Keep a result, or note why there is none."""
    try:
        run.done[unit.name] = {"machine": unit.machine, **job.keep(home, unit, future.result())}
    except (BrokenExecutor, CancelledError):
        raise
    except DtwinError as error:
        run.failed[unit.name] = error.as_dict()
    except Exception as error:
        said = f"{type(error).__name__}: {error}"[:500]
        run.failed[unit.name] = {"code": "fleet.failed", "message": said, "where": unit.name}


def _killed(unit: Unit) -> StoreError:
    return StoreError(
        "the process that worked on it died",
        code="fleet.killed",
        where=unit.name,
        hint="look at its memory; dtwin fleet --workers 1 shows what happens",
    )


def _died(run: FleetRun, units: list[Unit], on: str) -> StoreError:
    return StoreError(
        "the scheduler died",
        code="fleet.died",
        where=on,
        got=f"{len(run.done)} of {len(units)} are done and kept",
        hint="give the same command again when it is back, or --on local",
    )


def _stopped(run: FleetRun, units: list[Unit]) -> Interrupted:
    return Interrupted(
        f"stopped; {len(run.done)} of {len(units)} are done and kept",
        code="fleet.stopped",
        hint="give the same command again to go on",
    )


_FORMS = "local, dask://host:port on this computer, dask+tls://host:port"
_CONNECT_S = 10
# A worker that died may be back between two looks.
_LOOK_S, _LOOKS = 20.0, 3


@dataclass(frozen=True)
class _Engine:
    """An executor and how much work it is given at once.

    ``slots``: units that are under way at most; what is not under way costs no memory.
    ``workers``: returns how many work; 0 where nobody answers.
    """

    executor: Executor
    slots: int
    workers: Callable[[], int] = lambda: 1


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


def _require_engine(on: str, workers: int | None) -> str:
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
def engine(on: str = "local", workers: int | None = None) -> Iterator[_Engine]:
    """Start an engine, and stop it at the end; work that has not begun by then is given up.

    ``on``: ``local``, or the address of a Dask scheduler: ``dask://host:port`` on this computer,
    ``dask+tls://host:port`` with the certificates that Dask's own configuration names.
    ``workers``: processes of ``local``; 1 works in line. By default one for each processor.
    Raises ``InputError`` as :func:`require_engine`.
    Raises ``StoreError`` when no scheduler answers, or it has no worker.
    """
    scheduler = _require_engine(on, workers)
    with _dask(scheduler) if scheduler else _local(workers or processors()) as running:
        yield running


@contextmanager
def _local(workers: int) -> Iterator[_Engine]:
    if workers == 1:
        yield _Engine(_InLine(), 1)
        return
    # Not forked: a copy of a process with threads may hold a lock that nobody opens again.
    spawn = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(workers, mp_context=spawn, initializer=end_with, initargs=(os.getpid(),))
    try:
        yield _Engine(pool, 2 * workers)
    finally:
        pool.shutdown(cancel_futures=True)


@contextmanager
def _dask(address: str) -> Iterator[_Engine]:
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

        def working() -> int:
            try:
                return len(client.sync(client.scheduler.ncores, callback_timeout=_CONNECT_S))
            except (OSError, TimeoutError):
                return 0

        # Not pure: a result is asked for again only when it is wanted again.
        yield _Engine(client.get_executor(pure=False), 2 * workers, working)
