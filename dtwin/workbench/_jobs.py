"""Work that takes longer than a page may: one after the other, in a thread of its own."""

from __future__ import annotations

import contextlib
import json
import logging
import queue
import secrets
import threading
import time
from collections.abc import Callable
from contextvars import Context, copy_context
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from dtwin.atomic import write_text
from dtwin.errors import DtwinError
from dtwin.failures import fault_of
from dtwin.progress import Tell, telling

_MOST_KEPT = 40
_Work = Callable[[Tell], str]


@dataclass
class Job:
    """A piece of work.

    ``state``: where it is; ``interrupted`` when the server ended first.
    ``begun``: ISO 8601.
    ``address``: page to go to when it is done.
    ``error``: what went wrong, as the command line words it.
    """

    id: str
    title: str
    state: Literal["waiting", "running", "done", "failed", "interrupted"] = "waiting"
    stage: str = "waiting for the work before it"
    begun: str = ""
    seconds: float = 0.0
    address: str = ""
    error: str = ""

    @property
    def ended(self) -> bool:
        """Whether nothing more will happen."""
        return self.state in ("done", "failed", "interrupted")


class Jobs:
    """Work in the order in which it was asked for.

    Every change of state is kept in a file, so that a server that was killed says at its next
    start what it did not finish. What a job stores is whole or absent.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._jobs: dict[str, Job] = {job.id: job for job in _left_behind(folder)}
        for job in self._jobs.values():
            if not job.ended:
                job.state = "interrupted"
                job.stage = "the server ended before this was finished; start it again"
                self._note(job)
        self._queue: queue.Queue[tuple[Job, _Work, Context]] = queue.Queue()
        threading.Thread(target=self._run, daemon=True, name="workbench-jobs").start()

    def start(self, title: str, work: _Work) -> Job:
        """Queue work and return at once. ``work``: gets a function that tells the stage; returns the page to go to."""
        begun = datetime.now(UTC).isoformat(timespec="seconds")
        job = Job(secrets.token_hex(8), title, begun=begun)
        self._note(job)
        self._jobs[job.id] = job
        # Of who asked: his name stands under what is done.
        self._queue.put((job, work, copy_context()))
        return job

    def get(self, job_id: str) -> Job | None:
        """Return a job, None for one that is not known."""
        return self._jobs.get(job_id)

    def unfinished(self) -> list[Job]:
        """Return the jobs that wait, run, or were interrupted, oldest first."""
        shown = ("waiting", "running", "interrupted")
        return [job for job in list(self._jobs.values()) if job.state in shown]

    def forget(self, job_id: str) -> None:
        """Drop a job that has ended."""
        job = self._jobs.get(job_id)
        if job is not None and job.ended:
            del self._jobs[job_id]
            (self.folder / f"{job_id}.json").unlink(missing_ok=True)

    def _run(self) -> None:
        while True:
            job, work, context = self._queue.get()
            context.run(self._do, job, work)
            for old in [j for j in list(self._jobs.values()) if j.ended][:-_MOST_KEPT]:
                self.forget(old.id)

    def _do(self, job: Job, work: _Work) -> None:
        since = time.monotonic()

        def tell(stage: str) -> None:
            job.stage, job.seconds = stage, time.monotonic() - since

        job.state = "running"
        tell("started")
        try:
            self._note(job)
            with telling(tell):
                job.address = work(tell)
            job.state = "done"
        except DtwinError as error:
            job.error, job.state = error.render(), "failed"
        except Exception as error:
            if (fault := fault_of(error)) is None:
                logging.getLogger(__name__).exception("%s failed", job.title)
            job.error = f"error[internal]: {type(error).__name__}: {error}" if fault is None else fault.render()
            job.state = "failed"
        job.seconds = time.monotonic() - since
        # On a full disk the work is over all the same, and so is not the thread: later work would wait for ever.
        with contextlib.suppress(DtwinError):
            self._note(job)

    def _note(self, job: Job) -> None:
        write_text(self.folder / f"{job.id}.json", json.dumps(asdict(job)), "the note of a job")


def _left_behind(folder: Path) -> list[Job]:
    jobs: list[Job] = []
    for path in folder.glob("*.json"):
        try:
            document: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
            jobs.append(Job(**document))
        except (OSError, ValueError, TypeError, RecursionError):
            with contextlib.suppress(OSError):
                path.unlink()
    return sorted(jobs, key=lambda job: job.begun)
