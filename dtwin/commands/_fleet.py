"""Commands that do the same for many machines: diagnose, train, recheck."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dtwin.commands._output import Json, ProgressLine, emit
from dtwin.commands.tasks import FleetCommands
from dtwin.config import home
from dtwin.errors import EXIT_USER, InputError
from dtwin.report.text import table
from dtwin.units import shown_number

if TYPE_CHECKING:
    from dtwin.fleet.jobs import Job
    from dtwin.fleet.run import FleetRun

_Machines = Annotated[list[str] | None, typer.Option("--machine", help="May be repeated; all without.")]
_On = Annotated[
    str | None,
    typer.Option(help="local, or a Dask scheduler: dask://host:port here, dask+tls://host:port; else DTWIN_ENGINE."),
]
_Workers = Annotated[
    int | None, typer.Option(min=1, max=1024, help="Processes of local, one a processor; 1 works in line.")
]
_Seed = Annotated[int, typer.Option(min=0, help="Seed of what is drawn.")]

app = typer.Typer(
    name="fleet", cls=FleetCommands, no_args_is_help=True, help="The same for many machines, on one computer or many."
)


@app.command()
def diagnose(machine: _Machines = None, on: _On = None, workers: _Workers = None, as_json: Json = False) -> None:
    """Find from nothing what the runs of every campaign can tell; what was diagnosed before is passed over."""
    from dtwin.fleet.jobs import DIAGNOSE

    _run(DIAGNOSE, machine, on, workers, 0, as_json)


@app.command()
def train(
    machine: _Machines = None, on: _On = None, workers: _Workers = None, seed: _Seed = 1, as_json: Json = False
) -> None:
    """Train on the newest campaign of every machine that has new runs, and register; nothing is promoted."""
    from dtwin.fleet.jobs import TRAIN

    _run(TRAIN, machine, on, workers, seed, as_json)


@app.command()
def recheck(
    machine: _Machines = None,
    days: Annotated[float, typer.Option(min=0.0, help="Pass over champions that were checked since.")] = 1.0,
    on: _On = None,
    workers: _Workers = None,
    seed: _Seed = 0,
    as_json: Json = False,
) -> None:
    """Measure every machine with and without its champion again, and withdraw those that harm."""
    from dtwin.fleet.jobs import recheck_job

    _run(recheck_job(days), machine, on, workers, seed, as_json)


@app.command()
def nightly(
    folder: Annotated[Path | None, typer.Option(help="Where new measurements arrive.")] = None,
    machine: _Machines = None,
    on: _On = None,
    workers: _Workers = None,
    seed: _Seed = 0,
    as_json: Json = False,
) -> None:
    """Take in what arrived, diagnose what is new, check champions, and tell what is late, failed or changed."""
    from dtwin.fleet.nightly import nightly as night_of

    lines = {stage: ProgressLine(stage, quiet=as_json) for stage in ("diagnose", "recheck", "history")}
    night = night_of(
        home(),
        folder=folder,
        machines=_known(machine),
        on=on or home().engine,
        workers=workers,
        seed=seed,
        progress=lambda stage, *step: lines[stage](*step),
    )

    def text() -> str:
        taken = sum(event.outcome == "ingested" for event in night.arrived)
        lines = [
            f"{taken} taken in, {len(night.diagnosed.done)} campaigns diagnosed, "
            f"{len(night.rechecked.done)} champions checked"
        ]
        if night.alerts:
            lines.append(table(("alert", "what"), [[alert.key, alert.text] for alert in night.alerts]))
        told = night.told
        if told is not None:
            lines += [f"told by {name}: {count}" for name, count in told.sent.items()]
            lines += [f"not told by {name}: {why}" for name, why in told.failed.items()]
            lines += [f"silenced: {key}" for key in told.silenced]
        return "\n".join(lines)

    emit(night.as_dict(), text, as_json=as_json)


@app.command()
def show(machine: _Machines = None, as_json: Json = False) -> None:
    """Show the newest diagnosis of every machine, the worst first; also while diagnose is at work."""
    from dtwin.fleet.alerts import fleet_view

    lines = fleet_view(home(), _known(machine))
    head = ("machine", "day", "campaign", "systematic µm", "floor µm", "found")
    rows = [
        [
            m["machine"],
            str(m["started"] or "-")[:10],
            m["campaign"],
            _um(m["systematic_rms_um"]),
            _um(m["noise_floor_um"]),
            ", ".join(m["found"]) or m["verdict"],
        ]
        for m in lines
    ]
    nothing = "nothing was diagnosed yet: dtwin fleet diagnose"
    emit({"machines": lines}, lambda: table(head, rows) if rows else nothing, as_json=as_json)


@app.command("sisters")
def sister_machines(
    type: Annotated[str, typer.Option(help="Machines whose record states this type (dtwin machine add --type).")] = "",
    machine: _Machines = None,
    as_json: Json = False,
) -> None:
    """Compare machines of one type by figures of their newest tests and sizes of faults: what is usual, and which one differs."""
    from dtwin.fleet.sisters import sisters
    from dtwin.report.faults import with_k2

    if bool(type) == bool(machine):
        raise InputError(
            "which machines?",
            code="fleet.sisters",
            allowed="--type TYPE, or --machine several times",
            got=type or "neither",
        )
    sizes = sisters(home(), _known(machine) or (), type, ProgressLine("machines", quiet=as_json))

    def text() -> str:
        rows = [
            [
                f"{size.effect} {size.name}",
                m.machine,
                with_k2(m.value, m.k2, size.unit),
                with_k2(m.with_sisters, m.with_sisters_k2, size.unit),
                with_k2(size.mean, 2.0 * size.spread, size.unit),
                f"differs (p = {m.p_value:.2g})" if m.differs else "",
            ]
            for size in sizes
            for m in size.machines
        ]
        return table(("size", "machine", "by itself", "with sisters", "mean ± 2 s of the type", ""), rows)

    emit({"sizes": [size.as_dict() for size in sizes]}, text, as_json=as_json)


def _um(value: float | None) -> str:
    return "-" if value is None else shown_number(value)


def _known(machines: list[str] | None) -> list[str]:
    """Return machines as they were named; one that nobody knows is refused: nothing would be done of it, every night."""
    from dtwin.pipeline.machine_history import require_machine

    for name in machines or ():
        require_machine(home(), name)
    return machines or []


def _run(job: Job, machines: list[str] | None, on: str | None, workers: int | None, seed: int, as_json: bool) -> None:
    from dtwin.fleet.run import run_fleet

    progress = ProgressLine(job.name, quiet=as_json)
    run = run_fleet(
        home(), job, _known(machines), on=on or home().engine, workers=workers, seed=seed, progress=progress
    )
    emit(run.as_dict(), lambda: _text(run), as_json=as_json)
    if run.failed:
        raise typer.Exit(EXIT_USER)


def _text(run: FleetRun) -> str:
    lines = []
    if run.done:
        rows = [
            [name, said["machine"], *(str(value) for key, value in said.items() if key != "machine")]
            for name, said in sorted(run.done.items())
        ]
        titles = [key.replace("_", " ") for key in next(iter(run.done.values())) if key != "machine"]
        lines.append(table(("", "machine", *titles), rows))
    lines += [f"failed: {name}: {error['message']}" for name, error in sorted(run.failed.items())]
    reasons: dict[str, list[str]] = {}
    for name, why in run.passed.items():
        reasons.setdefault(why, []).append(name)
    lines += [f"passed over, {why}: {_listed(names)}" for why, names in reasons.items()]
    lines.append(f"{len(run.done)} done, {len(run.failed)} failed, {len(run.passed)} passed over")
    return "\n".join(lines)


def _listed(names: list[str]) -> str:
    return ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")
