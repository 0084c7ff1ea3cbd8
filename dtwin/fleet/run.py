"""Do a job for many machines on an engine, keep what comes back, and say what failed."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Future, wait
from dataclasses import dataclass, field, replace
from typing import Any

from dtwin.config import Home
from dtwin.errors import DtwinError, Interrupted, StoreError
from dtwin.fleet.engine import Engine, engine, require_engine
from dtwin.fleet.jobs import Job, Unit
from dtwin.locks import locked
from dtwin.progress import Progress

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
    progress: Progress | None = None,
) -> FleetRun:
    """Do a job for machines, and keep every result as it comes.

    Units that were kept are not there the next time: a job that was interrupted goes on. What is kept does not
    depend on the engine.

    ``machines``: all of the home without names.
    ``on``, ``workers``: as for :func:`dtwin.fleet.engine.engine`.
    Raises ``StoreError`` when another process does the same job in this home, or the scheduler died.
    """
    require_engine(on, workers)
    with locked(home.root / "locks" / f"fleet-{job.name}.lock") as mine:
        if not mine:
            raise StoreError(
                "another process does the same for this home",
                code="store.busy",
                where=str(home.root),
                got=f"fleet {job.name}",
                hint="wait for it, or stop it: what it did is kept",
            )
        units, passed = job.units(home, machines)
        run = FleetRun(job.name, on, passed=passed)
        alone, tries = False, 0
        while todo := [unit for unit in units if unit.name not in run.done and unit.name not in run.failed]:
            tries += 1
            try:
                with engine(on, workers) as at:
                    for unit, future in _answers(replace(at, slots=1) if alone else at, home, job, todo, seed):
                        _take(run, home, job, unit, future)
                        if progress is not None:
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


def _answers(at: Engine, home: Home, job: Job, units: list[Unit], seed: int) -> Iterator[tuple[Unit, Future[Any]]]:
    """Yield units and their futures as they end; a few are under way at once."""
    rest = iter(units)
    under_way: dict[Future[Any], Unit] = {}
    while True:
        while len(under_way) < at.slots and (unit := next(rest, None)) is not None:
            under_way[at.executor.submit(job.work, str(home.root), unit, seed)] = unit
        if not under_way:
            return
        ended, _ = wait(under_way, return_when=FIRST_COMPLETED)
        for future in ended:
            yield under_way.pop(future), future


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
