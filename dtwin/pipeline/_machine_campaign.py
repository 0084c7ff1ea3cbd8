"""A campaign on a machine, test by test: hand out the program, record, take the file, judge it.

What has been done lies in the campaign folder, so that the same call goes on after an
interruption, a killed process or a power cut. Whether the machine exists or is simulated is
nowhere asked.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dtwin.acquire.arrivals import Arrival, Arrivals, Stamp
from dtwin.acquire.b5r import read_b5r
from dtwin.acquire.campaign_folder import open_campaign
from dtwin.acquire.instrument import Instrument
from dtwin.acquire.quality import judge_run
from dtwin.acquire.run_recording import InForce, RunRequest, record_run, recover_runs, withdraw_run
from dtwin.atomic import whole_file, write_text
from dtwin.errors import DeviceError, InputError, Interrupted, StoreError
from dtwin.pipeline._campaign_steps import Step
from dtwin.pipeline.desk import DONE, KEEP, REPEAT, Desk, Question
from dtwin.schema import Finding, Run

_STATE = "campaign-state.json"
_SUFFIX = ".b5r"
_POLL_S = 0.5
_CLOSE = 1e-3


@dataclass(frozen=True)
class Job:
    """A campaign to be measured.

    ``folder``: campaign folder; created.
    ``inbox``: folder that the reference instrument's program writes its files to.
    ``steps``: in order.
    ``head``: tables ``machine_geometry`` and ``instrument`` of the campaign file.
    ``instruments``: returns what records sensors and controller meanwhile, closed; called for every run.
    ``in_force``: tells which correction was in force between two times.
    ``serving_now``: tells which one is in force now.
    ``settle_s``: time for which a file must stand still before it is taken, unless the operator says ``done``.
    """

    name: str
    machine: str
    folder: Path
    inbox: Path
    steps: tuple[Step, ...]
    head: Mapping[str, Mapping[str, Any]]
    instruments: Callable[[], Sequence[Instrument]]
    in_force: InForce
    serving_now: Callable[[], str]
    settle_s: float = 10.0


@dataclass
class _State:
    """What is known besides the campaign file; written whole after every change."""

    plan: str
    accepted: list[str] = field(default_factory=list)
    taken: dict[str, str] = field(default_factory=dict)
    aside: int = 0


def measure_campaign(job: Job, desk: Desk, asked: Callable[[], bool]) -> dict[str, Any]:
    """Measure what a folder lacks of a campaign.

    ``asked``: whether to stop; asked several times a second.
    JSON-ready: ``folder``, ``measured``, ``kept``, ``set_aside``, and ``findings`` by run.
    """
    return _Campaign(job, desk, asked).run()


class _Campaign:
    def __init__(self, job: Job, desk: Desk, asked: Callable[[], bool]) -> None:
        self._job, self._desk, self._asked = job, desk, asked
        self._state = _State(_plan_sha256(job))
        self._findings: dict[str, list[dict[str, Any]]] = {}
        self._arrivals = Arrivals(job.inbox, job.settle_s, _is_reference)
        self._next_look_s = 0.0

    def run(self) -> dict[str, Any]:
        job = self._job
        self._go_on()
        kept = len(self._state.accepted)
        for number, step in enumerate(job.steps, start=1):
            while step.run_id not in self._state.accepted:
                if self._is_there(step) or self._measure(step, number):
                    self._judge(step, number)
        self._desk.clear()
        return {
            "campaign": job.name,
            "machine": job.machine,
            "folder": str(job.folder),
            "kept": kept,
            "measured": len(self._state.accepted) - kept,
            "set_aside": self._state.aside,
            "findings": self._findings,
        }

    def _go_on(self) -> None:
        """Read where an earlier process stopped; what it left in the making is put aside."""
        job = self._job
        job.folder.mkdir(parents=True, exist_ok=True)
        path = job.folder / _STATE
        if path.exists():
            known = _read_state(path)
            if known.plan != self._state.plan:
                raise StoreError(
                    "the folder holds another plan's measurements",
                    code="campaign.other_plan",
                    where=str(job.folder),
                    hint="use another folder, or the plan that it was begun with",
                )
            self._state = known
        elif (job.folder / "campaign.toml").exists():
            raise StoreError(
                "the folder holds a campaign that was measured in another way",
                code="campaign.other_plan",
                where=str(job.folder),
                hint="use another folder",
            )
        self._keep()
        for left in recover_runs(job.folder, job.in_force):
            self._put_aside(left.run_id, "its recording was interrupted")

    def _measure(self, step: Step, number: int) -> bool:
        """Hand a test out and record until its file is here; false when an instrument failed."""
        job, desk = self._job, self._desk
        programs = _written(job.folder / "programs", step)
        what = f"{step.run_id} ({number} of {len(job.steps)}): {step.title}"
        self._await_correction(step, number, what)
        before = self._present()
        told = "\n".join(
            [
                what,
                *(f"  program: {path}" for path in programs),
                f"  run it, and let the instrument save its file in {job.inbox}",
            ]
        )
        question = Question(step.run_id, told, (DONE,), tuple(map(str, programs)), number, len(job.steps))
        reference = f"{step.run_id}{_SUFFIX}"
        request = RunRequest(
            job.folder, job.name, job.machine, step.run_id, None, reference, step.stated, job.head, job.in_force
        )
        desk.ask(question)
        refused: dict[Path, Stamp] = {}
        taken: list[Arrival] = []

        def ended() -> bool:
            if self._asked():
                return True
            if not taken and (arrived := self._arrived(before, refused)) is not None:
                with whole_file(job.folder / reference, "the instrument's file") as partial:
                    shutil.copyfile(arrived.path, partial)
                taken.append(arrived)
            return bool(taken)

        try:
            record_run(job.instruments(), request, ended)
        except DeviceError as error:
            if not self._is_there(step):
                raise
            desk.show(error.render())
            self._put_aside(step.run_id, "an instrument failed")
            return False
        if not taken:
            if self._is_there(step):
                withdraw_run(job.folder, step.run_id)
            raise self._stopped()
        self._state.taken[_sha256(job.folder / reference)] = step.run_id
        self._keep()
        return True

    def _present(self) -> dict[Path, Stamp]:
        """Return what the inbox holds before a test; a share that is gone is waited for."""
        said = False
        while not self._asked():
            try:
                return self._arrivals.present()
            except OSError as error:
                if not said:
                    reason = error.strerror or error
                    self._desk.show(f"{self._job.inbox} cannot be read now: {reason}; waiting")
                said = True
                time.sleep(_POLL_S)
        raise self._stopped()

    def _stopped(self) -> Interrupted:
        return Interrupted(
            f"{len(self._state.accepted)} of {len(self._job.steps)} tests are kept",
            code="campaign.interrupted",
            where=str(self._job.folder),
            hint="run the same command again to continue",
        )

    def _await_correction(self, step: Step, number: int, what: str) -> None:
        """Wait until the correction that the test asks for is in force, or none."""
        if not any(other.correction for other in self._job.steps):
            return
        said = False
        while self._job.serving_now() != step.correction:
            if not said:
                text = f"{what}\n  {step.ask_for_correction}"
                self._desk.ask(Question(step.run_id, text, (), (), number, len(self._job.steps)))
                said = True
            if self._asked():
                raise self._stopped()
            time.sleep(_POLL_S)

    def _arrived(self, before: Mapping[Path, Stamp], refused: dict[Path, Stamp]) -> Arrival | None:
        """Return a new file that the reader accepts."""
        done = self._desk.answer() == DONE
        now = time.monotonic()
        if not done and now < self._next_look_s:
            return None
        self._next_look_s = now + _POLL_S
        try:
            settled = self._arrivals.look()
            present = self._arrivals.present()
        except OSError:
            # A share that is gone comes back.
            return None
        # Who says "done" need not wait until the file has stood still for long.
        chosen = [Arrival(p, s) for p, s in sorted(present.items())] if done else settled
        fresh = [a for a in chosen if before.get(a.path) != a.stamp and refused.get(a.path) != a.stamp]
        for arrival in fresh:
            if why := self._refusal(arrival.path):
                refused[arrival.path] = arrival.stamp
                self._desk.show(f"{arrival.path.name} is not taken: {why}")
            else:
                return arrival
        if done and not fresh:
            self._desk.show(f"no new file in {self._job.inbox} yet")
            self._desk.again()
        return None

    def _refusal(self, path: Path) -> str:
        try:
            read_b5r(path)
            known = self._state.taken.get(_sha256(path))
        except InputError as error:
            return error.message
        except OSError as error:
            return error.strerror or str(error)
        return f"it is the file of {known} again" if known else ""

    def _judge(self, step: Step, number: int) -> None:
        """Accept a run, or ask whether to repeat it."""
        folder = open_campaign(self._job.folder)
        (entry,) = [e for e in folder.entries if e.run_id == step.run_id]
        runs, _ = folder.read(entry)
        findings = [f for run in runs for f in (*run.findings, *judge_run(run), *_strange(run, step))]
        self._findings[step.run_id] = [finding.as_dict() for finding in findings]
        spoilt = [finding for finding in findings if finding.severity == "error"]
        answer = KEEP
        if spoilt:
            lines = "\n".join(f"  {f.severity}: {f.message}" for f in findings)
            text = f"{step.run_id} is spoilt:\n{lines}\n  repeat it, or keep it as it is?"
            self._desk.ask(Question(step.run_id, text, (REPEAT, KEEP), (), number, len(self._job.steps)))
            answer = self._await_answer()
        else:
            self._desk.show(f"{step.run_id}: taken, {len(findings)} remarks, nothing wrong")
        if answer == REPEAT:
            self._put_aside(step.run_id, "repeated")
            return
        self._state.accepted.append(step.run_id)
        self._keep()

    def _await_answer(self) -> str:
        while (answer := self._desk.answer()) is None:
            if self._asked():
                raise self._stopped()
            time.sleep(_POLL_S)
        return answer

    def _put_aside(self, run_id: str, why: str) -> None:
        place = withdraw_run(self._job.folder, run_id)
        self._state.aside += 1
        self._keep()
        self._desk.show(f"{run_id}: {why}; its files are in {place}")

    def _is_there(self, step: Step) -> bool:
        if not (self._job.folder / "campaign.toml").exists():
            return False
        entries = open_campaign(self._job.folder).entries
        return any(entry.run_id == step.run_id for entry in entries)

    def _keep(self) -> None:
        text = json.dumps(vars(self._state), indent=1)
        write_text(self._job.folder / _STATE, text, "the state of the campaign")


def _read_state(path: Path) -> _State:
    try:
        return _State(**json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError) as error:
        raise StoreError(
            "what was measured so far cannot be read",
            code="campaign.state",
            where=str(path),
            got=str(error)[:160],
            hint="remove the file and use another folder; this one can be ingested",
        ) from error


def _strange(run: Run, step: Step) -> Iterator[Finding]:
    """Compare a run with what was asked for."""
    meta, asked = run.meta, step.stated
    told = [
        f"{name} {getattr(meta, name)} instead of {asked[name]}"
        for name in ("plane", "radius_mm", "feed_mm_min")
        if name in asked and _differ(getattr(meta, name), asked[name])
    ]
    if told:
        text = f"the file is of another test: {', '.join(told)}"
        yield Finding("campaign.other_test", "error", text)
    if meta.correction not in (step.correction, "mixed"):
        was = f"under {meta.correction[:12]}" if meta.correction else "without a correction"
        text = f"it was measured {was}, and should have been {step.wanted}"
        yield Finding("campaign.other_way", "error", text)


def _differ(one: object, other: object) -> bool:
    if isinstance(one, int | float) and isinstance(other, int | float):
        return abs(one - other) > _CLOSE * abs(other)
    return one != other


def _is_reference(path: Path) -> bool:
    return path.suffix.lower() == _SUFFIX


def _written(folder: Path, step: Step) -> list[Path]:
    return [write_text(folder / name, text, "a program") for name, text in step.programs.items()]


def _plan_sha256(job: Job) -> str:
    steps = [[s.run_id, dict(s.stated), s.correction] for s in job.steps]
    text = json.dumps([job.name, job.machine, steps], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
