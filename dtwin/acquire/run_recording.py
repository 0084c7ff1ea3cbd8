"""Record one run into a campaign folder; what a killed process had recorded is not lost.

Before anything is recorded the folder learns of the run in ``<run>.intent.json``. The run enters
``campaign.toml`` when its streams are sealed: at the end, or when the folder is recovered.
"""

from __future__ import annotations

import json
import math
import threading
import time
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import tomli_w

from dtwin.acquire._recording import SUFFIX, Recorder
from dtwin.acquire._recovery import Sealed, covariates_of, recover_folder, seal
from dtwin.acquire.campaign_folder import open_campaign
from dtwin.acquire.instrument import Instrument, Patient, record
from dtwin.atomic import write_text
from dtwin.errors import DtwinError, InputError, StoreError
from dtwin.local_time import was_set
from dtwin.locks import locked
from dtwin.schema import DEFAULT_KIND, Finding, require_name

_INTENT = ".intent.json"
_LOCK = ".recording.lock"
_ASIDE = "set-aside"
_RUN = "\n[[run]]\n"
InForce = Callable[[datetime, datetime], str]
_JOIN_S = 30.0
_WATCH_S = 0.1


@dataclass(frozen=True)
class RunRequest:
    """What to record, and where.

    ``folder``: campaign folder; created.
    ``campaign``, ``machine``: names for ``campaign.toml``, when the folder has none yet.
    ``duration_s``: time to record in s; None until stopped.
    ``reference``: name, inside the folder, of the reference instrument's file of this run.
    ``stated``: further settings of the ``[[run]]``, such as plane and radius.
    ``head``: tables ``machine_geometry`` and ``instrument`` for ``campaign.toml``, when the folder has none yet.
    ``in_force``: returns which correction was in force between two times, as the run shall say it.
    """

    folder: Path
    campaign: str
    machine: str
    run_id: str
    duration_s: float | None
    reference: str
    stated: Mapping[str, Any] = field(default_factory=dict)
    head: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    in_force: InForce = lambda begin, end: ""


@dataclass(frozen=True)
class RecordedRun:
    """A run that is in its campaign folder.

    ``sealed``: one signal file per instrument.
    ``findings``: about the instruments and what came from them; gaps are in ``sealed``.
    """

    run_id: str
    sealed: tuple[Sealed, ...]
    findings: tuple[Finding, ...]
    reference: Path


def record_run(
    instruments: Sequence[Instrument], request: RunRequest, asked_to_stop: Callable[[], bool]
) -> RecordedRun:
    """Record instruments at the same time, each by its own clock, and seal what came.

    ``instruments``: closed; opened and closed here. Without any, only the reference instrument measures.
    ``asked_to_stop``: asked ten times a second; true ends the recording in order.

    Raises ``InputError`` when the run exists already, or a name is unusable.
    Raises ``DeviceError`` when a device is absent, or fails; what came before is sealed and marked incomplete.
    Raises ``StoreError`` when the folder cannot be written.
    """
    with _alone(request.folder), ExitStack() as opened:
        _require_new(request)
        for instrument in instruments:
            opened.enter_context(instrument)
        for instrument in instruments:
            instrument.check()
        _write_intent(request)
        sealed: tuple[Sealed, ...] = ()
        try:
            try:
                _record_all(instruments, request, asked_to_stop)
            finally:
                sealed = _finish(request.folder, request.run_id, request.in_force)
        except DtwinError as error:
            if sealed:
                kept = f"what came before is kept in {request.folder}, run {request.run_id}"
                error.hint = f"{error.hint}; {kept}" if error.hint else kept
            raise
        findings = tuple(f for instrument in instruments for f in instrument.check())
    return RecordedRun(request.run_id, sealed, findings, request.folder / request.reference)


def recover_runs(folder: Path, in_force: InForce = lambda begin, end: "") -> list[RecordedRun]:
    """Seal what dead processes left in a folder, and enter their runs in ``campaign.toml``.

    ``folder``: campaign folder; one that does not exist holds nothing.
    ``in_force``: as for :class:`RunRequest`.

    Raises ``StoreError`` when somebody records into the folder, or a stream is damaged.
    """
    if not folder.is_dir():
        return []
    with _alone(folder):
        runs = []
        for path in sorted(folder.glob(f"*{_INTENT}")):
            run_id = path.name.removesuffix(_INTENT)
            intent = _read_intent(path)
            sealed = _finish(folder, run_id, in_force)
            runs.append(RecordedRun(run_id, sealed, (), folder / intent["reference"]))
        # Streams of other programs, which have no run of ours.
        recover_folder(folder)
    return runs


def _record_all(instruments: Sequence[Instrument], request: RunRequest, asked_to_stop: Callable[[], bool]) -> None:
    ending = threading.Event()
    errors: list[DtwinError] = []
    threads = [
        threading.Thread(target=_record_one, args=(instrument, request, ending, errors), name=instrument.name)
        for instrument in instruments
    ]
    for thread in threads:
        thread.start()
    until_s = math.inf if request.duration_s is None else time.monotonic() + request.duration_s
    try:
        while any(thread.is_alive() for thread in threads) or not threads:
            if asked_to_stop():
                ending.set()
                for instrument in instruments:
                    if isinstance(instrument, Patient):
                        instrument.hurry()
            if not threads and (ending.is_set() or time.monotonic() >= until_s):
                break
            time.sleep(_WATCH_S)
    finally:
        ending.set()
        for thread in threads:
            thread.join(_JOIN_S)
    if errors:
        raise errors[0]


def _record_one(instrument: Instrument, request: RunRequest, ending: threading.Event, errors: list[DtwinError]) -> None:
    what = instrument.describe()
    stream = request.folder / f"{request.run_id}.{what.group}{SUFFIX}"
    limit = None if request.duration_s is None else request.duration_s * what.rate_hz

    def wanted(n_samples: int) -> bool:
        return not ending.is_set() and (limit is None or n_samples < limit)

    try:
        with Recorder(stream, what.group, what.rate_hz, what.columns, notes=what.notes) as recorder:
            instrument.start()
            record(instrument, recorder, wanted)
            instrument.stop()
    except DtwinError as error:
        errors.append(error)
        ending.set()


def _finish(folder: Path, run_id: str, in_force: InForce) -> tuple[Sealed, ...]:
    """Seal the streams of a run, enter it in ``campaign.toml``, and forget the intent."""
    intent_path = folder / f"{run_id}{_INTENT}"
    intent = _read_intent(intent_path)
    begun, ended = datetime.fromisoformat(intent["started"]), _last_written(folder, run_id)
    sealed = []
    for path in sorted(folder.glob(f"{run_id}.*{SUFFIX}")):
        try:
            done = seal(path, path.with_suffix(".parquet"))
        except StoreError as error:
            if error.code != "recording.empty":
                raise
            path.unlink()
            continue
        if done.n_samples:
            sealed.append(done)
        else:
            # The device never started: there is no run to keep.
            done.path.unlink()
    # Sealed by a process that died before it came here.
    names = sorted(path.name for path in folder.glob(f"{run_id}.*.parquet"))
    there = names or (folder / intent["reference"]).exists()
    if there and run_id not in _known_runs(folder):
        covariates = {k: v for name in names for k, v in covariates_of(folder / name).items()}
        if covariates:
            intent["stated"] = dict(intent["stated"]) | {"covariates": covariates}
        _enter(folder, intent, names, in_force(begun, max(begun, ended)))
    intent_path.unlink()
    return tuple(sealed)


def withdraw_run(folder: Path, run_id: str) -> Path:
    """Take a run out of ``campaign.toml`` again and put its files aside; nothing is deleted.

    ``folder``: campaign folder that :func:`record_run` wrote.
    ``run_id``: the run; it need not have been entered.

    Returns the folder with its files, below ``set-aside``.
    """
    with _alone(folder):
        toml = folder / "campaign.toml"
        if toml.exists():
            head, *runs = toml.read_text(encoding="utf-8").split(_RUN)
            kept = [run for run in runs if tomllib.loads(run).get("id") != run_id]
            if kept:
                write_text(toml, _RUN.join([head, *kept]), "the campaign file")
            else:
                toml.unlink()
        places = (folder / _ASIDE / f"{run_id}-{n}" for n in range(1, 10_000))
        aside = next(place for place in places if not place.exists())
        aside.mkdir(parents=True)
        for file in [*folder.glob(f"{run_id}.*"), *folder.glob(f"{run_id}-reference.*")]:
            file.rename(aside / file.name)
    return aside


def _last_written(folder: Path, run_id: str) -> datetime:
    """Return when a recording wrote last: it may have died long ago."""
    times = [path.stat().st_mtime for path in folder.glob(f"{run_id}.*")]
    return datetime.fromtimestamp(max(times), UTC)


def _enter(folder: Path, intent: Mapping[str, Any], signals: Sequence[str], correction: str) -> None:
    path = folder / "campaign.toml"
    # What a clock says that was never set is no day of a test.
    told = intent["started"]
    started = {"started": told} if was_set(datetime.fromisoformat(told)) else {}
    head = (
        path.read_text(encoding="utf-8").rstrip()
        if path.exists()
        else tomli_w.dumps(
            {
                "campaign": {
                    "name": intent["campaign"],
                    "machine": intent["machine"],
                    "kind": DEFAULT_KIND,
                    **started,
                    **intent["head"],
                }
            }
        ).rstrip()
    )
    run = {
        "id": intent["run"],
        "file": intent["reference"],
        **started,
        **({"signals": list(signals)} if signals else {}),
        **({"correction": correction} if correction else {}),
        **intent["stated"],
    }
    text = f"{head}\n\n{tomli_w.dumps({'run': [run]})}"
    write_text(path, text, "the campaign file")


def _require_new(request: RunRequest) -> None:
    folder, run_id = request.folder, require_name(request.run_id, "the run")
    require_name(request.campaign, "the campaign")
    require_name(request.machine, "the machine")
    left = [path.name for path in folder.glob(f"{run_id}.*") if path.name != request.reference]
    if run_id in _known_runs(folder) or left:
        raise InputError(
            "there is a run of this name already",
            code="record.exists",
            where=str(folder),
            got=", ".join([run_id, *left])[:200],
            hint="name another run, or record into another folder",
        )


def _known_runs(folder: Path) -> set[str]:
    if not (folder / "campaign.toml").exists():
        return set()
    return {entry.run_id for entry in open_campaign(folder).entries}


def _write_intent(request: RunRequest) -> None:
    intent = {
        "run": request.run_id,
        "campaign": request.campaign,
        "machine": request.machine,
        "reference": request.reference,
        "started": datetime.now(UTC).isoformat(timespec="milliseconds"),
        "stated": dict(request.stated),
        "head": {name: dict(content) for name, content in request.head.items()},
    }
    path = request.folder / f"{request.run_id}{_INTENT}"
    write_text(path, json.dumps(intent, indent=1), "the run's intent")


def _read_intent(path: Path) -> dict[str, Any]:
    try:
        intent: dict[str, Any] = {"head": {}} | json.loads(path.read_text(encoding="utf-8"))
        return {key: intent[key] for key in ("run", "campaign", "machine", "reference", "started", "stated", "head")}
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise StoreError(
            "what a recording was meant for cannot be read",
            code="record.intent",
            where=str(path),
            got=str(error)[:200],
            hint="remove the file; the signals stay, enter them in campaign.toml yourself",
        ) from error


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Hold the folder against another recording."""
    with locked(folder / _LOCK) as mine:
        if not mine:
            raise StoreError(
                "another process records into this folder",
                code="record.busy",
                where=str(folder),
                hint="wait for it, or use another folder",
            )
        yield
