"""One serving session: from a model's name to a released correction and a line in the log."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from dtwin.config import Home
from dtwin.errors import (
    EXIT_DEVICE,
    EXIT_DONE,
    EXIT_GATE,
    EXIT_INTERRUPTED,
    DtwinError,
    GateRefusal,
    InputError,
)
from dtwin.features.tone_window import COMMAND_PHASE
from dtwin.features.windows import WindowContract
from dtwin.links.ur import UrLink
from dtwin.serve.analogue_link import (
    NO_TOOL_MM,
    AnalogueLink,
    AnalogueWiring,
    within_travel,
)
from dtwin.serve.barred import BarredWatch
from dtwin.serve.bundle import Bundle
from dtwin.serve.bundle_file import load_bundle
from dtwin.serve.controller_kind import is_virtual
from dtwin.serve.decision import Decision, SensorSource
from dtwin.serve.journal import journal
from dtwin.serve.lease import lease
from dtwin.serve.live_board import live_board
from dtwin.serve.loop import Mode, ServeStatus
from dtwin.serve.machine_serving import RATE_HZ, MachineServing, ServingRequest
from dtwin.serve.pointer import Resolved, read_machine, resolve
from dtwin.serve.runtime import CompiledBundle
from dtwin.serve.signals import stop_on_signals

TRIAL_SHARE = 0.25
"""Share of a bundle's clamp that a trial may use."""


Announce = Callable[[str], None]
OpenSensors = Callable[[WindowContract], AbstractContextManager[SensorSource]]

# By an input that only they have: corrections that no link takes to a machine.
_ONLY_VIRTUAL = {
    COMMAND_PHASE: ("tones", "dtwin turning compensate runs it at 8 kHz on the virtual slide"),
    "position_in": (
        "a position",
        "dtwin lathe compensate runs it every 10 ms on the virtual lathe",
    ),
}


@dataclass(frozen=True)
class ServeRequest:
    """What a user asked for.

    Attributes
    ----------
    model : str
        ``latest``, ``trial``, or the path of a bundle.
    machine : str or None
        Machine; None when only one has a model.
    host : str
        Address of the robot.
    duration_s : float or None
        Time to serve; None until stopped.
    mode : {"live", "shadow", "dry-run"}
        As in ``ServingLoop``.
    trial : bool
        Serve under the tight clamp of a trial, whatever the model's state.
    priority : int
        Real-time priority, 0 for none.
    covariates : mapping of str to float
        Values of covariate inputs.
    patience_s : float
        How long to wait for a lost link to come back, and for a protective stop to be unlocked;
        0 ends the serving at once.
    analogue : AnalogueWiring or None
        Board and state feed of an analogue correction; None for a robot at ``host``.
    """

    model: str = "latest"
    machine: str | None = None
    host: str = "127.0.0.1"
    duration_s: float | None = None
    mode: Mode = "live"
    trial: bool = False
    priority: int = 60
    covariates: Mapping[str, float] = field(default_factory=dict)
    patience_s: float = 0.0
    analogue: AnalogueWiring | None = None

    @property
    def place(self) -> str:
        """Where the machine's end is: a robot's address, or a board's port."""
        return self.host if self.analogue is None else self.analogue.port

    def serving(self) -> ServingRequest:
        """Return how the machine is to be served."""
        end = "robot" if self.analogue is None else "board"
        duration_s = math.inf if self.duration_s is None else self.duration_s
        return ServingRequest(
            f"{end} at {self.place}", self.mode, duration_s, self.patience_s, self.priority,
            RATE_HZ if self.analogue is None else self.analogue.states_hz,
        )  # fmt: skip

    def __post_init__(self) -> None:
        """Refuse a time that is none."""
        if not 0.0 <= self.patience_s < math.inf:
            raise InputError(
                "the patience is not a time to wait",
                code="serve.patience",
                got=f"{self.patience_s} s",
                allowed="0 s or more",
            )
        if self.duration_s is not None and not 0.0 < self.duration_s < math.inf:
            raise InputError(
                "the duration is not a time to serve",
                code="serve.duration",
                got=f"{self.duration_s} s",
                allowed="more than 0 s; leave it out to serve until Ctrl-C",
            )
        if not 0 <= self.priority <= 99:
            raise InputError(
                "no such priority",
                code="serve.priority",
                got=str(self.priority),
                allowed="0 (none) to 99",
            )


@dataclass(frozen=True)
class Served:
    """What came of a session.

    Attributes
    ----------
    request : ServeRequest
        What was asked for.
    resolved : Resolved
        What the model's name stood for.
    device : {"real", "virtual"}
        What answered at the address.
    trial : bool
        Whether the clamp was tightened.
    clamp_um : float
        Longest correction that was allowed.
    status : ServeStatus
        How it went.
    driver_realtime : bool
        Whether the driver process was given real-time priority.
    log : str
        Path of the session log, or why there is none.
    """

    request: ServeRequest
    resolved: Resolved
    device: str
    trial: bool
    clamp_um: float
    status: ServeStatus
    driver_realtime: bool
    log: str = ""

    @property
    def exit_code(self) -> int:
        """4 after a fault, 3 when the model was withdrawn, 130 when stopped before the time that was asked for, else 0."""
        if self.status.ended == "withdrawn":
            return EXIT_GATE
        if self.status.fault is not None:
            return EXIT_DEVICE
        early = self.status.ended == "stopped" and self.request.duration_s is not None
        return EXIT_INTERRUPTED if early else EXIT_DONE

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        found = self.resolved
        return {
            "machine": found.machine,
            "model": {
                "asked": self.request.model,
                "version": found.version,
                "state": found.state,
                "bundle": str(found.path),
                "sha256": found.sha256,
            },
            "host": self.request.place,
            "device": self.device,
            "trial": self.trial,
            "clamp_um": self.clamp_um,
            "driver_realtime": self.driver_realtime,
            "log": self.log,
            **self.status.as_dict(),
        }


def serve(
    request: ServeRequest, home: Home, announce: Announce, open_sensors: OpenSensors | None = None
) -> Served:
    """Serve a model to a robot until the time is up, a stop is asked for, or something fails.

    Call it in the main thread of a process that runs nothing else.

    Parameters
    ----------
    request : ServeRequest
        What to serve, where, how long.
    home : Home
        Where pointers, locks and logs lie.
    announce : callable
        Receives lines for the user while it goes on.
    open_sensors : callable, optional
        Opens what delivers the windows of a contract; called when the model needs windows.

    Returns
    -------
    Served
        A fault while serving is in it, not raised.

    Raises
    ------
    InputError
        When a file is missing or unusable.
    GateRefusal
        When the model may not be served so.
    DeviceError
        When the robot is absent or served already.
    StoreError
        When the lease cannot be taken.
    """
    resolved = resolve(request.model, request.machine, home, harmless=request.mode != "live")
    announce(f"{request.model} is {resolved.describe()}")
    started = datetime.now(UTC)
    try:
        served = _serve_resolved(request, resolved, home, announce, open_sensors)
    except DtwinError as error:
        record = {"ended": error.code, "fault": error.as_dict(), "host": request.place}
        model = {"version": resolved.version, "state": resolved.state}
        _write_log(home, resolved.machine, started, {**record, "model": model}, announce)
        raise
    log = _write_log(home, resolved.machine, started, served.as_dict(), announce)
    return dataclasses.replace(served, log=log)


def _require_device(machine: str, inputs: Sequence[str]) -> None:
    for name, (what, where) in _ONLY_VIRTUAL.items():
        if name in inputs:
            raise InputError(
                f"no device is known for a correction of {what}", code="serve.virtual_only",
                where=f"machine {machine}", got=", ".join(inputs),
                hint=f"{where}; a real machine has not been tried",
            )  # fmt: skip


def _serve_resolved(
    request: ServeRequest, resolved: Resolved, home: Home, announce: Announce,
    open_sensors: OpenSensors | None,
) -> Served:  # fmt: skip
    compiled = load_bundle(resolved.path, resolved.machine)
    _require_device(resolved.machine, compiled.bundle.tick_inputs)
    trial = request.trial or resolved.state == "trial"
    if trial:
        compiled = with_trial_clamp(compiled)
        limit_um = compiled.bundle.safety.clamp_um
        announce(f"trial: the correction is limited to {limit_um:.1f} um, a quarter of its clamp")
    if request.analogue is None:
        tcp_mm = read_machine(resolved.machine, home).tcp
    else:
        compiled, tcp_mm = within_travel(compiled), NO_TOOL_MM
    with contextlib.ExitStack() as held:
        events = held.enter_context(journal(events_path(home, resolved.machine), announce))
        if request.mode != "shadow":
            held.enter_context(lease(request.place, resolved.machine, home))
        window = compiled.bundle.window
        sensors = held.enter_context(open_sensors(window)) if open_sensors and window else None
        decision = Decision(compiled, tcp_mm, request.covariates, sensors)
        door = _Door(request, compiled.bundle, trial)
        board = None
        # A shadow holds no lease: the board belongs to who holds it.
        if request.mode != "shadow":
            board = held.enter_context(live_board(
                resolved.machine, home, clamp_um=compiled.bundle.safety.clamp_um,
                period_s=1.0 / request.serving().rate_hz, started_s=time.time(),
            ))  # fmt: skip
        serving = MachineServing(
            request.serving(), decision, door, events.note,
            BarredWatch(resolved.machine, home, resolved.version), board,
        )  # fmt: skip
        held.callback(serving.close)
        time_text = "until Ctrl-C" if request.duration_s is None else f"{request.duration_s:g} s"
        announce(
            f"serving the {door.device} controller at {request.place}, {request.mode}, {time_text}"
        )
        model = {"version": resolved.version, "state": resolved.state}
        events.note("serving", at=request.place, mode=request.mode, model=model, pid=os.getpid())
        with stop_on_signals() as asked:
            status = serving.run(asked)
        events.note("released" if status.released else "not_released", why=status.ended)
        return Served(
            request, resolved, door.device, trial, compiled.bundle.safety.clamp_um, status,
            serving.realtime,
        )  # fmt: skip


class _Door:
    """Opens a link of the kind that was asked for, and judges what answers."""

    def __init__(self, request: ServeRequest, bundle: Bundle, trial: bool) -> None:
        self._request, self._bundle, self._trial = request, bundle, trial
        self.device = ""

    def __call__(self) -> UrLink | AnalogueLink:
        request = self._request
        writes = request.mode != "shadow"
        if request.analogue is not None:
            # Nothing that a serial port answers proves that no machine hangs on it.
            self._judge("real")
            return AnalogueLink(request.analogue, writes=writes, moves=request.mode == "live")
        link = UrLink(request.host, RATE_HZ, realtime=request.priority > 0, writes=writes)
        try:
            self._judge("virtual" if is_virtual(link.host) else "real")
        except BaseException:
            link.close()
            raise
        return link

    def _judge(self, device: str) -> None:
        self.device = device
        require_evidence(self._bundle, device, mode=self._request.mode, trial=self._trial)


def events_path(home: Home, machine: str) -> Path:
    """Return the file of the events of a machine's sessions."""
    return home.logs / f"serve-{machine}.events.jsonl"


def with_trial_clamp(compiled: CompiledBundle) -> CompiledBundle:
    """Return the model with a quarter of its clamp."""
    bundle = compiled.bundle
    safety = dataclasses.replace(bundle.safety, clamp_um=TRIAL_SHARE * bundle.safety.clamp_um)
    return CompiledBundle(dataclasses.replace(bundle, safety=safety))


def require_evidence(bundle: Bundle, device: str, *, mode: Mode, trial: bool) -> None:
    """Refuse to move a real device on evidence from a virtual one, outside a trial.

    Raises
    ------
    GateRefusal
        When the bundle has no evidence from a real device.
    """
    evidence = bundle.provenance.evidence
    if device == "virtual" or mode != "live" or trial or evidence == "real":
        return
    raise GateRefusal(
        "the model was never shown to help a real machine",
        code="serve.evidence",
        got=f"evidence: {evidence}",
        allowed="evidence: real",
        hint="try it under a tight clamp with --trial, or look at it with --shadow",
    )


def _write_log(
    home: Home, machine: str, started: datetime, record: Mapping[str, Any], announce: Announce
) -> str:
    """Append one JSON line; a log that cannot be written never stops the serving."""
    path = home.logs / f"serve-{machine}.jsonl"
    ended = datetime.now(UTC)
    line = {
        "started": started.isoformat(timespec="milliseconds"),
        "duration_s": round((ended - started).total_seconds(), 3),
        **record,
    }
    plain = json.loads(json.dumps(line), parse_constant=lambda word: None)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("ab", buffering=0) as file:
            file.write(json.dumps(plain).encode() + b"\n")
    except OSError as error:
        reason = f"not written: {error.strerror or error}"
        announce(f"the session log {path} was {reason}")
        return reason
    return str(path)
