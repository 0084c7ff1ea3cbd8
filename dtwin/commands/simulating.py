"""The command that measures campaigns on virtual machines."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dtwin.commands.output import ProgressLine, emit
from dtwin.errors import InputError

Json = Annotated[bool, typer.Option("--json", help="Print only JSON on stdout.")]

MACHINES = ("cobot", "mill", "lathe", "turning", "volumetric", "hexapod")


def register(app: typer.Typer) -> None:
    """Add the command of this module to the application."""
    app.command()(simulate)


def simulate(
    out: Annotated[Path, typer.Option(help="Campaign folder to write.")],
    machine: Annotated[
        str, typer.Option(help=f"Virtual machine: {', '.join(MACHINES)}.")
    ] = "cobot",
    plan: Annotated[
        Path | None, typer.Option(help="Plan file; the machine's own campaign without.")
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="A small campaign.")] = False,
    seed: Annotated[int, typer.Option(help="Seed of the machine.")] = 0,
    hidden: Annotated[
        str, typer.Option(help="Fault of the mill: backlash, wobble, servo, none.")
    ] = "backlash",
    truth: Annotated[
        str | None,
        typer.Option(
            help="Error of the lathe: published, mechanism; of turning: linear, hardening, friction; "
            "thermocouples of the volumetric mill: surface, pockets."
        ),
    ] = None,
    schedule: Annotated[
        str, typer.Option(help="Heat of the volumetric mill: training, or validation.")
    ] = "training",
    listen: Annotated[
        int | None,
        typer.Option(
            help="Port (0: a free one) for dtwin serve --link axes, which corrects lathe, turning or "
            "volumetric while they are measured."
        ),
    ] = None,
    wall_clock: Annotated[
        bool, typer.Option("--wall-clock", help="With --listen: in real time, not time-lapsed.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Measure a campaign on a virtual machine. Run it again to continue."""
    if machine not in MACHINES:
        raise InputError(
            "no such virtual machine",
            code="simulate.machine",
            got=machine[:40],
            allowed=", ".join(MACHINES),
        )
    if listen is not None or wall_clock:
        from dtwin.commands.listening import simulate_served

        simulate_served(
            out, machine, plan, truth, schedule, seed=seed, quick=quick, port=listen,
            clock="wall" if wall_clock else "machine", as_json=as_json,
        )  # fmt: skip
    elif machine == "turning":
        from dtwin.commands.turning import simulate_tones

        simulate_tones(out, plan, truth or "linear", seed=seed, quick=quick, as_json=as_json)
    elif machine == "volumetric":
        from dtwin.commands.volumetric import simulate_heat

        heat = truth or "surface"
        simulate_heat(out, plan, heat, schedule, seed=seed, quick=quick, as_json=as_json)
    elif machine == "lathe":
        from dtwin.commands.lathe import simulate_positioning

        error = truth or "published"
        simulate_positioning(out, plan, error, seed=seed, quick=quick, as_json=as_json)
    elif machine == "mill":
        _simulate_mill(out, seed=seed, quick=quick, hidden=hidden, as_json=as_json)
    else:
        _simulate_circles(out, machine, plan, seed=seed, quick=quick, as_json=as_json)


def _simulate_mill(out: Path, *, seed: int, quick: bool, hidden: str, as_json: bool) -> None:
    from dtwin.acquire.virtual_mill import simulate_mill

    progress = ProgressLine("measure", quiet=as_json)
    runs = simulate_mill(out, seed=seed, quick=quick, hidden=hidden, progress=progress)
    payload = {"folder": str(out), "runs": len(runs), "campaign": f"mill-{hidden}"}
    text = f"{len(runs)} runs in {out}\nnext: dtwin ingest {out}"
    emit(payload, lambda: text, as_json=as_json)


def _simulate_circles(
    out: Path, machine: str, plan: Path | None, *, seed: int, quick: bool, as_json: bool
) -> None:
    from dtwin.acquire.runner import run_campaign
    from dtwin.acquire.virtual import VirtualCobotBench
    from dtwin.acquire.virtual_hexapod import VirtualHexapodBench, feed_sweep
    from dtwin.pipeline.demo import quick_size
    from dtwin.plan import read_plan, training_plan

    if plan is not None:
        planned = read_plan(plan)
    elif machine == "hexapod":
        planned = feed_sweep(quick=quick)
    else:
        planned = quick_size().plan if quick else training_plan()
    bench = VirtualHexapodBench(seed) if machine == "hexapod" else VirtualCobotBench(seed)
    done = run_campaign(planned, bench, out, ProgressLine("measure", quiet=as_json))
    payload = {
        "folder": str(done.folder),
        "measured": done.measured,
        "kept": done.kept,
        "raw_bytes": done.raw_bytes,
        "campaign": planned.name,
    }
    text = (
        f"{done.measured} tests measured, {done.kept} kept from before, in "
        f"{done.folder}\nnext: dtwin ingest {done.folder}"
    )
    emit(payload, lambda: text, as_json=as_json)
