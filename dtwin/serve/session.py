"""One serving session: from a model's name to a released correction and a line in the log."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from datetime import UTC, datetime
from functools import partial
from typing import Any

from dtwin.atomic import append_line
from dtwin.config import Home
from dtwin.errors import DtwinError, InputError
from dtwin.features.windows import WindowContract
from dtwin.machine_record import changed_since
from dtwin.serve._axis_inputs import AxisInputs
from dtwin.serve._axis_lockstep import serve_machine_clock
from dtwin.serve._connection import AxisConnection, Connection, with_trial_clamp
from dtwin.serve._journal import NOT_RELEASED, RELEASED, SERVING, journal
from dtwin.serve._lease import lease
from dtwin.serve._machine_serving import MachineServing, Stop
from dtwin.serve.analogue_link import NO_TOOL_MM, within_travel
from dtwin.serve.band import require_fading
from dtwin.serve.bundle import Bundle
from dtwin.serve.bundle_file import load_bundle
from dtwin.serve.decision import STANDARD_INPUTS, Decision, SensorSource
from dtwin.serve.live_board import live_board
from dtwin.serve.loop import ServeStatus
from dtwin.serve.pointer import Resolved, read_machine, resolve
from dtwin.serve.proved import require_proof
from dtwin.serve.realtime import stop_on_signals
from dtwin.serve.runtime import CompiledBundle
from dtwin.serve.serve_request import Served, ServeRequest
from dtwin.serve.served_time import events_path
from dtwin.serve.withdrawn import WithdrawalWatch

_Announce = Callable[[str], None]
OpenSensors = Callable[[WindowContract], AbstractContextManager[SensorSource]]


def serve(request: ServeRequest, home: Home, announce: _Announce, open_sensors: OpenSensors | None = None) -> Served:
    """Serve a model to a robot until the time is up, a stop is asked for, or something fails.

    Call it in the main thread of a process that runs nothing else.

    Args:
        announce: Receives lines for the user while it goes on.
        open_sensors: Opens what delivers the windows of a contract; called when the model needs windows.

    Returns:
        A fault while serving is in it, not raised.

    Raises:
        InputError: When a file is missing or unusable.
        GateRefusal: When the model may not be served so.
        DeviceError: When the robot is absent or served already.
        StoreError: When the lease cannot be taken.
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


def _serve_resolved(
    request: ServeRequest, resolved: Resolved, home: Home, announce: _Announce, open_sensors: OpenSensors | None
) -> Served:
    compiled = load_bundle(resolved.path, resolved.machine)
    # Of the model as it was promoted: a trial's clamp is no other model.
    model_sha256 = compiled.bundle.model_sha256
    trial = request.trial or resolved.state == "trial"
    if trial:
        compiled = with_trial_clamp(compiled)
        limit_um = compiled.bundle.safety.clamp_um
        announce(f"trial: the correction is limited to {limit_um:z.1f} µm, a quarter of its clamp")
    elif request.mode == "live":
        changed = ""
        if resolved.proved:
            # A record that cannot be read is no reason to stop a machine.
            with contextlib.suppress(DtwinError):
                changed = changed_since(home, resolved.machine, resolved.proved, doubtful=True)
        announce(require_proof(resolved, compiled.bundle, request.expired, changed=changed))
    if request.fade is not None:
        compiled = _with_fading(compiled, request.fade)
    if request.analogue is not None:
        compiled = within_travel(compiled)
    announce(_uncertainty_said(compiled))
    bundle = compiled.bundle
    _require_control(request, bundle)
    robot = request.analogue is None and request.axes is None
    machine = read_machine(resolved.machine, home) if robot else None
    with contextlib.ExitStack() as held:
        events = held.enter_context(journal(events_path(home, resolved.machine), announce))
        if request.mode != "shadow":
            held.enter_context(lease(request.place, resolved.machine, home))
        window = bundle.window
        sensors = held.enter_context(open_sensors(window)) if open_sensors and window else None
        sampled_elsewhere = sensors is not None or request.axes is None
        inputs = AxisInputs(bundle, request.covariates, sensors=sampled_elsewhere)
        connection = _connection(request, bundle, trial, inputs, home)
        held.callback(connection.close)
        rate_hz = connection.rate_hz
        decision = Decision(
            compiled,
            machine.tcp if machine else NO_TOOL_MM,
            request.covariates,
            sensors or inputs.windows,
            inputs.live,
            machine.largest if machine else None,
        )
        board = None
        # A shadow holds no lease: the board belongs to who holds it.
        if request.mode != "shadow":
            board = held.enter_context(
                live_board(
                    resolved.machine,
                    home,
                    clamp_um=bundle.safety.clamp_um,
                    period_s=1.0 / rate_hz,
                    corrects=request.mode == "live",
                )
            )
        withdrawn = WithdrawalWatch(resolved.machine, home, resolved.version)
        run: Callable[[Stop], ServeStatus]
        if isinstance(connection, AxisConnection) and connection.clock == "machine":
            run = partial(serve_machine_clock, connection(), decision, inputs, request, events.note, withdrawn, board)
        else:
            serving = MachineServing(request.serving(rate_hz), decision, connection, events.note, withdrawn, board)
            held.callback(serving.close)
            run = serving.run
        time_text = "until Ctrl-C" if request.duration_s is None else f"{request.duration_s:g} s"
        announce(f"serving the {connection.device} controller at {request.place}, {request.mode}, {time_text}")
        model = {"version": resolved.version, "state": resolved.state}
        events.note(
            SERVING,
            at=request.place,
            mode=request.mode,
            model=model,
            pid=os.getpid(),
            model_sha256=model_sha256,
            device=connection.device,
            trial=trial,
        )
        with stop_on_signals() as asked:
            status = run(lambda: asked() or connection.finished)
        if connection.finished and status.ended == "stopped":
            status = dataclasses.replace(status, ended="finished")
        events.note(RELEASED if status.released else NOT_RELEASED, why=status.ended)
        return Served(
            request,
            resolved,
            connection.device,
            trial,
            bundle.safety.clamp_um,
            status,
            connection.realtime,
            band=bundle.band.basis if bundle.band else "",
            fades=compiled.fades,
        )


def _with_fading(compiled: CompiledBundle, fade: bool) -> CompiledBundle:
    if fade:
        require_fading(compiled.bundle.band)
    return CompiledBundle(compiled.bundle, fades=fade)


def _uncertainty_said(compiled: CompiledBundle) -> str:
    """Say whether the bundle tells the uncertainty of its correction, and what comes of it."""
    band = compiled.bundle.band
    if band is None:
        return "the model does not say how uncertain its correction is: nothing fades out"
    told = f"the model says how uncertain its correction is (k = 2, from {band.basis})"
    what = "what is smaller than that fades out" if compiled.fades else "nothing fades out"
    return f"{told}: {what}"


def _connection(request: ServeRequest, bundle: Bundle, trial: bool, inputs: AxisInputs, home: Home) -> Connection:
    """Return the way to the machine; an axis control has greeted then."""
    if request.axes is None:
        return Connection(request, bundle, trial)
    connection = AxisConnection(request, bundle, trial, inputs, home)
    if inputs.watch is not None and connection.clock == "wall":
        connection.close()
        raise InputError(
            "a sine cannot be corrected over a network in real time",
            code="serve.tones",
            where=request.place,
            got="a control on the wall clock",
            hint="export the bundle to the control: dtwin export --as c",
        )
    return connection


def _require_control(request: ServeRequest, bundle: Bundle) -> None:
    """Refuse a model whose inputs only a control sends, where none was named, and a value in place of what is measured."""
    takes = [i.name for i in bundle.inputs if i.source == "covariate"]
    if strange := sorted(set(request.covariates) - set(takes)):
        raise InputError(
            "the model takes no such covariate",
            code="serve.covariate",
            where=f"machine {bundle.machine}",
            got=", ".join(strange)[:200],
            allowed=", ".join(takes) or "none: all its inputs are measured",
        )
    known = {*STANDARD_INPUTS, *request.covariates}
    unknown = [name for name in bundle.tick_inputs if name not in known]
    if unknown and request.axes is None:
        raise InputError(
            "the model needs inputs that only the machine's control can send",
            code="serve.inputs",
            where=f"machine {bundle.machine}",
            got=", ".join(unknown)[:200],
            hint="a control that sends them: dtwin serve --link axes --states HOST:PORT; or give a "
            "covariate its value: --covariate NAME=NUMBER",
        )


def _write_log(home: Home, machine: str, started: datetime, record: Mapping[str, Any], announce: _Announce) -> str:
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
        append_line(path, json.dumps(plain).encode())
    except OSError as error:
        reason = f"not written: {error.strerror or error}"
        announce(f"the session log {path} was {reason}")
        return reason
    return str(path)
