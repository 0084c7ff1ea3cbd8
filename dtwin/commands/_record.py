"""The command that records sensors and a controller: record."""

from __future__ import annotations

import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dtwin.commands._output import Json, emit
from dtwin.config import home
from dtwin.errors import EXIT_INTERRUPTED, InputError

if TYPE_CHECKING:
    from dtwin.acquire.run_recording import RecordedRun, RunRequest

_TEXT_SETTINGS = ("plane", "direction", "setup")
_NUMBER_SETTINGS = ("radius_mm", "feed_mm_min", "repeat", "sample_rate_hz")

app = typer.Typer()


@app.command()
def record(
    out: Annotated[Path, typer.Option(help="Campaign folder; the run is added to it.")],
    sensors: Annotated[Path | None, typer.Option(help="Channel file of the accelerometers (TOML).")] = None,
    robot: Annotated[str | None, typer.Option(help="Address of a UR controller to record.")] = None,
    streams: Annotated[
        Path | None, typer.Option(help="Stream file (TOML): an MTConnect agent, topics of an MQTT broker.")
    ] = None,
    duration: Annotated[float | None, typer.Option(min=0.1, help="Seconds; without it until Ctrl-C.")] = None,
    run: Annotated[str | None, typer.Option(help="Name of the run; without it r001 on.")] = None,
    machine: Annotated[str, typer.Option(help="Name of the machine.")] = "machine",
    reference: Annotated[
        Path | None, typer.Option(help="File that the ball bar's program writes; copied when recording ends.")
    ] = None,
    setting: Annotated[
        list[str] | None, typer.Option("--set", help="Setting of the run, for example plane=XY or radius_mm=100.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Record accelerometers, a robot's controller, an MTConnect agent or an MQTT broker as a run of a campaign folder.

    What a killed recording left in the folder is recovered first.
    """
    from dtwin.acquire.instruments import recorders
    from dtwin.acquire.run_recording import record_run, recover_runs
    from dtwin.serve.realtime import stop_on_signals
    from dtwin.serve.served_time import correction_in_force

    stated = _stated(setting or [])
    instruments = recorders(sensors, robot, streams)
    if not instruments:
        raise InputError(
            "there is nothing to record",
            code="record.nothing",
            hint="name a channel file with --sensors, a controller with --robot, a stream file with --streams",
        )
    in_force = correction_in_force(home(), machine)
    for recovered in recover_runs(out, in_force):
        print(f"recovered what a killed recording left: {run_text(recovered)}", file=sys.stderr)
    request = replace(
        _request(out, run, machine, duration, reference, stated), head=_head(out, robot), in_force=in_force
    )
    with stop_on_signals(from_first_asked=True) as asked:
        print(f"recording {request.run_id}; Ctrl-C ends it", file=sys.stderr, flush=True)
        done = record_run(instruments, request, asked)
        early = asked() and duration is not None
    if reference is not None:
        _take_reference(reference, done.reference)
    emit(_payload(done, out), lambda: _text(done, out), as_json=as_json)
    if early:
        raise typer.Exit(EXIT_INTERRUPTED)


def _request(
    out: Path, run: str | None, machine: str, duration: float | None, reference: Path | None, stated: dict[str, Any]
) -> RunRequest:
    from dtwin.acquire.run_recording import RunRequest

    run_id = run or _next_run(out)
    suffix = ".b5r" if reference is None else reference.suffix.lower()
    # Signal files are Parquet, too, and begin with the run's name and a dot.
    name = f"{run_id}-reference.parquet" if suffix == ".parquet" else f"{run_id}{suffix}"
    return RunRequest(out, out.resolve().name, machine, run_id, duration, name, stated)


def _head(out: Path, robot: str | None) -> dict[str, dict[str, Any]]:
    """Return what a new campaign file says of the machine; runs of a virtual one must not hide it."""
    from dtwin.acquire.campaign_folder import open_campaign
    from dtwin.serve.controller_kind import is_virtual

    if robot is None or not is_virtual(robot):
        return {}
    known = open_campaign(out).campaign if (out / "campaign.toml").exists() else None
    if known is not None and not known.machine_geometry.get("virtual", False):
        raise InputError(
            "the controller is a virtual one, and the folder's runs are of a real machine",
            code="record.virtual",
            where=str(out),
            got=robot,
            hint="record into another folder",
        )
    return {"machine_geometry": {"virtual": True}}


def _next_run(out: Path) -> str:
    taken = {path.name.split(".")[0] for path in out.glob("r*.*")}
    return next(name for n in range(1, 100_000) if (name := f"r{n:03d}") not in taken)


def _stated(pairs: list[str]) -> dict[str, Any]:
    facts: dict[str, Any] = {}
    for pair in pairs:
        name, _, value = pair.partition("=")
        try:
            if name in _TEXT_SETTINGS and value:
                facts[name] = value
            elif name in _NUMBER_SETTINGS:
                facts[name] = int(value) if name == "repeat" else float(value)
            else:
                raise ValueError(name)
        except ValueError:
            raise InputError(
                "not a setting of a run",
                code="record.setting",
                got=pair[:80],
                allowed=", ".join((*_TEXT_SETTINGS, *_NUMBER_SETTINGS)) + ", as NAME=VALUE",
            ) from None
    return facts


def _take_reference(source: Path, target: Path) -> None:
    try:
        if source.resolve() != target.resolve():
            shutil.copyfile(source, target)
    except OSError as error:
        raise InputError(
            "the signals are recorded, but the reference instrument's file is not there",
            code="record.reference",
            where=str(source),
            got=error.strerror or str(error),
            hint=f"copy it to {target} when it is written",
        ) from error


def _payload(done: RecordedRun, out: Path) -> dict[str, Any]:
    return {
        "folder": str(out),
        "run": done.run_id,
        "reference": str(done.reference),
        "reference_there": done.reference.exists(),
        "signals": [
            {
                "file": str(s.path),
                "samples": s.n_samples,
                "bytes": s.n_bytes,
                "complete": s.complete,
                "findings": [f.as_dict() for f in s.findings],
            }
            for s in done.sealed
        ],
        "findings": [f.as_dict() for f in done.findings],
    }


def _text(done: RecordedRun, out: Path) -> str:
    lines = [run_text(done), *(f"  {f.severity}: {f.message}" for f in done.findings)]
    if done.reference.exists():
        return "\n".join([*lines, f"next: dtwin ingest {out}"])
    return "\n".join([*lines, f"next: copy the ball bar's file to {done.reference}, then: dtwin ingest {out}"])


def run_text(done: RecordedRun) -> str:
    """Return the files of a recorded run, and what is wrong with them, for people."""
    lines = [done.run_id]
    for file in done.sealed:
        lines.append(f"  {file.path.name}: {file.n_samples} samples, {file.n_bytes / 1e6:z.2f} MB")
        lines += [f"    {f.severity}: {f.message}" for f in file.findings]
    return "\n".join(lines)
