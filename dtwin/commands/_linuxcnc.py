"""Commands for LinuxCNC: the real controller with a simulated machine."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dtwin.commands._output import Json, ProgressLine, emit
from dtwin.config import home
from dtwin.errors import InputError

if TYPE_CHECKING:
    from dtwin.machines.linuxcnc.circles import Circle, Trace
    from dtwin.machines.linuxcnc.instance import LinuxcncSession
    from dtwin.serve.bundle import Bundle


app = typer.Typer(
    name="linuxcnc",
    help="LinuxCNC, the real controller, with a machine that is simulated in its HAL.",
    no_args_is_help=True,
)


@app.command("check")
def check(as_json: Json = False) -> None:
    """Start LinuxCNC once, contained, and say that it works or what is missing."""
    from dtwin.links.linuxcnc import Bridge
    from dtwin.machines.linuxcnc.instance import LinuxcncSession

    with LinuxcncSession() as session, Bridge(session.socket_path) as bridge:
        said = bridge.ask(do="status")
        # Its own answer, from inside: which network there is.
        where = (session.folder / "networks.txt").read_text(encoding="ascii").split()
    emit(
        {"enabled": said["enabled"], "networks": where},
        lambda: (
            f"LinuxCNC runs: power on, homed, motion enabled: {said['enabled']}; "
            f"networks that it sees: {', '.join(where)}"
        ),
        as_json=as_json,
    )


@app.command("measure")
def measure(
    out: Annotated[Path, typer.Option(help="Campaign folder to write.")],
    plane: Annotated[str, typer.Option(help="Planes, like XY,YZ.")] = "XY",
    radius: Annotated[str, typer.Option(help="Radii in mm, like 20,40.")] = "20,40",
    feed: Annotated[str, typer.Option(help="Feeds in mm/min.")] = "2000,4000,6000",
    repeats: Annotated[int, typer.Option(min=1, max=20, help="Of every condition.")] = 2,
    comp: Annotated[list[str] | None, typer.Option(help="Compensation file of an axis, like X=x.comp.")] = None,
    faults: Annotated[Path | None, typer.Option(help="What is wrong with the machine, like a truth.toml.")] = None,
    model: Annotated[
        str | None, typer.Option(help="Correction to serve live: latest or champion, trial, or a file.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the order, and of the bar's noise.")] = 0,
    as_json: Json = False,
) -> None:
    """Run circles both ways, recorded by the controller's sampler, as a campaign folder."""
    from dtwin.acquire.linuxcnc_circles import CirclePlan, require_free, write_circles
    from dtwin.machines.linuxcnc.configuration import MillFaults, read_faults
    from dtwin.machines.linuxcnc.instance import LinuxcncSession

    require_free(out)
    wrong = MillFaults() if faults is None else read_faults(faults)
    plan = CirclePlan(
        tuple(plane.split(",")),  # type: ignore[arg-type]
        _numbers(radius, "--radius"),
        _numbers(feed, "--feed"),
        repeats,
    )
    circles, bundle = plan.circles(seed), _bundle(model)
    with LinuxcncSession(wrong, _tables(comp or []), seed=seed) as session:
        measured, served = _measured(session, circles, bundle, quiet=as_json)
        write_circles(out, measured, session.faults, out.name)
    emit(
        {"folder": str(out), "runs": len(measured), "served": served},
        lambda: _said(out, len(measured), served),
        as_json=as_json,
    )


def _measured(
    session: LinuxcncSession, circles: list[Circle], bundle: Bundle | None, *, quiet: bool
) -> tuple[list[Trace], dict[str, object]]:
    line = ProgressLine("circles", quiet=quiet)
    if bundle is None:
        from dtwin.acquire.linuxcnc_circles import run_circles

        return run_circles(session, circles), {}
    from dtwin.pipeline.linuxcnc_correction import measure_live, served_figures

    live = measure_live(session, bundle, circles, line)
    return [m.trace for m in live], served_figures(live)


def _bundle(model: str | None) -> Bundle | None:
    if model is None:
        return None
    from dtwin.acquire.linuxcnc_circles import MACHINE
    from dtwin.serve.bundle import Bundle
    from dtwin.serve.bundle_file import MAX_BYTES, read_json
    from dtwin.serve.pointer import resolve

    # The machine is simulated: nothing can be harmed by a version on trial.
    named = None if model.endswith(".json") else MACHINE
    path = resolve(model, named, home(), harmless=True).path
    return Bundle.from_dict(read_json(path, MAX_BYTES))


def _said(out: Path, runs: int, served: dict[str, object]) -> str:
    lines = [f"{out}: {runs} runs, every sample of the controller there"]
    if served:
        lines.append(
            f"served live: {served['acted']}, largest {served['largest_um']:z.1f} µm, "
            f"dropped by the controller's watchdog {served['watchdog_trips']} times, "
            f"circles not corrected throughout: {served['interrupted']}"
        )
    return "\n".join(
        [*lines, f"next: dtwin twin fit {out} --effects scale_mismatch,squareness,servo_mismatch --name {out.name}"]
    )


def _tables(given: list[str]) -> dict[str, str]:
    from dtwin.machines.linuxcnc.configuration import AXES, compensation_text

    out = {}
    for entry in given:
        axis, _, file = entry.partition("=")
        if axis not in AXES or len(axis) != 1 or not file or axis in out:
            raise InputError(
                "a compensation file belongs to one axis",
                code="linuxcnc.comp",
                got=entry[:80],
                allowed="X=FILE, Y=FILE or Z=FILE, each once",
            )
        out[axis] = compensation_text(Path(file))
    return out


def _numbers(text: str, option: str) -> tuple[float, ...]:
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise InputError(f"{option} needs numbers", code="linuxcnc.numbers", got=text[:80], allowed="20,40") from None
