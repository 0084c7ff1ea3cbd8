"""The command that corrects a machine: serve."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dtwin.commands._output import Json, emit
from dtwin.config import home
from dtwin.errors import EXIT_DONE, EXIT_INTERRUPTED, DtwinError, InputError
from dtwin.report.text import classes, table
from dtwin.units import shown_number

if TYPE_CHECKING:
    from dtwin.serve.analogue_link import AnalogueWiring
    from dtwin.serve.loop import Mode, ServeStatus
    from dtwin.serve.proved import WhenExpired
    from dtwin.serve.serve_request import Served
    from dtwin.serve.session import OpenSensors

_BAR_WIDTH = 40

app = typer.Typer()


@app.command()
def serve(
    model: Annotated[str, typer.Option(help="latest or champion, trial, or a bundle's .json file.")] = "latest",
    machine: Annotated[str | None, typer.Option(help="Required when several machines have a model.")] = None,
    host: Annotated[str, typer.Option(help="Address of the robot controller.")] = "127.0.0.1",
    duration: Annotated[float | None, typer.Option(help="Seconds to serve; without it until Ctrl-C.")] = None,
    shadow: Annotated[bool, typer.Option("--shadow", help="Compute, but send nothing.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Send zeros only.")] = False,
    trial: Annotated[bool, typer.Option("--trial", help="Limit the correction to a quarter of its clamp.")] = False,
    sensors: Annotated[
        Path | None, typer.Option(help="Channel file (TOML), for a model that needs accelerometers.")
    ] = None,
    priority: Annotated[int, typer.Option(help="Real-time priority; 0 for none.")] = 60,
    covariate: Annotated[list[str] | None, typer.Option(help="Value of a covariate input, as NAME=NUMBER.")] = None,
    patience: Annotated[
        float, typer.Option(help="Seconds to wait for a lost link or an unlocked protective stop; 0 ends at once.")
    ] = 0.0,
    link: Annotated[
        str,
        typer.Option(
            help="ur: a robot over RTDE; analogue: a board that gives voltages; axes: a control that "
            "takes offsets of its axes."
        ),
    ] = "ur",
    port: Annotated[str | None, typer.Option(help="Serial port of the board, like /dev/ttyACM0.")] = None,
    states: Annotated[
        str | None, typer.Option(help="HOST:PORT of the control's state feed, or of its axis link.")
    ] = None,
    states_hz: Annotated[float, typer.Option(help="How often that feed sends a state.")] = 500.0,
    calibration: Annotated[Path | None, typer.Option(help="What dtwin analogue calibrate wrote.")] = None,
    watchdog_ms: Annotated[int, typer.Option(help="Silence after which the board goes neutral by itself.")] = 100,
    fade: Annotated[
        bool | None,
        typer.Option(
            "--fade/--no-fade",
            help="Whether a correction smaller than its own uncertainty fades out; by default where the model tells it.",
            show_default=False,
        ),
    ] = None,
    expired: Annotated[str, typer.Option(help="A champion whose evidence has expired: refuse or warn.")] = "refuse",
    pull: Annotated[
        str | None,
        typer.Option(help="Fetch the machine's bundles from the workbench at this address, before and meanwhile."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Correct a machine live with a promoted model; Ctrl-C releases the correction."""
    from dtwin.serve.serve_request import ServeRequest
    from dtwin.serve.session import serve as serve_session

    axes = states if link == "axes" else None
    wiring = (
        None
        if axes and port is None and calibration is None
        else _wiring(link, port, states, states_hz, calibration, watchdog_ms)
    )
    request = ServeRequest(
        model,
        machine,
        host,
        duration,
        _mode(shadow, dry_run),
        trial,
        priority,
        _covariates(covariate or []),
        patience,
        wiring,
        axes,
        _when_expired(expired),
        fade,
    )
    with _bundles(pull, machine):
        served = serve_session(request, home(), _announce, _sensors(sensors))
    emit(served.as_dict(), lambda: _render_served(served), as_json=as_json)
    if served.status.fault is not None:
        _announce(DtwinError(**served.status.fault).render())
    if served.exit_code == EXIT_INTERRUPTED:
        _announce("interrupted before the time was over; run the same command again to continue")
    if served.exit_code != EXIT_DONE:
        raise typer.Exit(served.exit_code)


def _bundles(url: str | None, machine: str | None) -> AbstractContextManager[None]:
    """Return what keeps the bundles of a machine those of another computer."""
    if url is None:
        return nullcontext()
    if machine is None:
        raise InputError("the machine must be named", code="pull.machine", hint="--machine NAME beside --pull")
    from dtwin.serve.pulling import pulled

    return pulled(url, machine, home(), _announce)


def _when_expired(said: str) -> WhenExpired:
    if said == "warn":
        return "warn"
    if said == "refuse":
        return "refuse"
    raise InputError(
        "expired evidence is refused, or warned of", code="serve.expired_option", got=said[:40], allowed="refuse, warn"
    )


def _render_served(served: Served) -> str:
    """Return the status of a session for people."""
    status, timing = served.status, served.status.timing
    resolved = served.resolved
    head = (
        f"{resolved.machine} version {resolved.version} ({resolved.state}) on the {served.device} "
        f"controller at {served.request.place}: {status.mode}, {status.clock} clock"
    )
    kept = "released" if status.released else "NOT confirmed as released by this end"
    lines = [
        head,
        f"  ended: {status.ended}; the correction is {kept}",
        f"  longest correction {status.largest_um:z.1f} µm, clamp {served.clamp_um:z.1f} µm"
        + (f"; uncertainty up to {shown_number(status.largest_band_um, 2)} µm (k = 2)" if served.band else ""),
        _tick_line(status),
        "",
        _percentiles("stage_us", timing["stage_us"]),
        "",
        _percentiles("time_ms", _times(timing)),
        "",
        "jitter of the period, µs",
        *_bars(timing["jitter_us_histogram"]),
        "",
        "what the guard did: " + _pairs(status.reasons),
        "real-time support: "
        + _pairs(status.realtime)
        + f", driver process: {'priority used' if served.driver_realtime else 'no priority'}",
        f"session log: {served.log}",
    ]
    return "\n".join(lines)


def _tick_line(status: ServeStatus) -> str:
    timing = status.timing
    if status.clock == "machine":
        return f"  {timing['ticks']} ticks, each waited for its correction"
    return (
        f"  {timing['ticks']} ticks, {timing['late_ticks']} late, {timing['missed_states']} "
        f"states missed ({100 * timing['late_share']:z.2f} % together), "
        f"{timing['timeouts']} waits without a state, {status.reconnects} links came back"
    )


def _times(timing: Mapping[str, Any]) -> dict[str, Any]:
    ages = {"period": timing["period_ms"], "state to correction": timing["state_age_ms"]}
    window = timing["window_age_ms"]
    return ages | ({"sensor window age": window} if window and window["max"] > 0 else {})


def _percentiles(title: str, rows: Mapping[str, Mapping[str, float] | None]) -> str:
    columns = ("p50", "p99", "p99.9", "max")
    return table(
        (title, *columns),
        [[name, *((figures or {}).get(column) for column in columns)] for name, figures in rows.items()],
    )


def _bars(histogram: Mapping[str, int]) -> list[str]:
    most = max([*histogram.values(), 1])
    return [
        f"  {label:>16}  {'#' * -(-_BAR_WIDTH * count // most):<{_BAR_WIDTH}}  {count}"
        for label, count in zip(classes(histogram), histogram.values(), strict=True)
        if count
    ]


def _pairs(found: Mapping[str, object]) -> str:
    return ", ".join(f"{name.replace('_', ' ')} {value}" for name, value in found.items()) or "-"


def _mode(shadow: bool, dry_run: bool) -> Mode:
    if shadow and dry_run:
        raise InputError(
            "a session is one or the other",
            code="serve.mode",
            got="--shadow --dry-run",
            allowed="--shadow (send nothing) or --dry-run (send zeros)",
        )
    return "shadow" if shadow else "dry-run" if dry_run else "live"


def _wiring(
    link: str, port: str | None, states: str | None, states_hz: float, calibration: Path | None, watchdog_ms: int
) -> AnalogueWiring | None:
    if link == "ur" and port is None and states is None and calibration is None:
        return None
    if link != "analogue" or port is None or states is None:
        raise InputError(
            "the link is not described",
            code="serve.link",
            got=f"--link {link}, --port {port}, --states {states}",
            allowed="--link ur; --link analogue with --port and --states; --link axes with --states",
        )
    from dtwin.serve.analogue_link import AnalogueWiring

    return AnalogueWiring(port, states, calibration, watchdog_ms, states_hz)


def _sensors(file: Path | None) -> OpenSensors | None:
    if file is None:
        return None
    # A file that is wrong is said before anything is connected.
    from dtwin.acquire.sensor_file import read_sensors

    return read_sensors(file).windows


def _covariates(pairs: list[str]) -> dict[str, float]:
    figures: dict[str, float] = {}
    for pair in pairs:
        name, _, value = pair.partition("=")
        try:
            figures[name] = float(value)
        except ValueError:
            raise InputError(
                "a covariate needs a number",
                code="serve.covariate",
                got=pair[:80],
                allowed="NAME=NUMBER, for example temperature_c=21.5",
            ) from None
    return figures


def _announce(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
