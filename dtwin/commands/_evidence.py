"""Commands about closed-loop evidence: evidence, computed from runs, and recheck of a champion."""

from __future__ import annotations

from typing import Annotated

import typer

from dtwin.commands._models import Machine, machine_named
from dtwin.commands._output import Json, ProgressLine, emit
from dtwin.config import home
from dtwin.errors import EXIT_GATE, InputError
from dtwin.report.text import table

app = typer.Typer()


@app.command()
def evidence(
    version: Annotated[str, typer.Argument(help="Version number, or candidate.")] = "candidate",
    without: Annotated[
        list[str] | None, typer.Option(help="Campaign in the lake measured without the correction.")
    ] = None,
    with_: Annotated[
        list[str] | None, typer.Option("--with", help="Campaign measured with it; one that holds both: name it twice.")
    ] = None,
    machine: Machine = None,
    as_json: Json = False,
) -> None:
    """Compute from runs in the lake what a version's correction does; promote reads it.

    Conditions are paired, the run is the unit, and the two ways must have taken turns.
    """
    from dtwin.lifecycle.evidence import compute
    from dtwin.report.campaign import evidence_advice, evidence_table
    from dtwin.train.evidence_record import newest
    from dtwin.train.registry import Registry

    if not without or not with_:
        raise InputError(
            "evidence needs runs of both ways",
            code="evidence.campaigns",
            allowed="--without CAMPAIGN --with CAMPAIGN, each as often as needed",
            hint="dtwin campaign --with VERSION measures them by turns",
        )
    registry = Registry(home())
    registered = registry.version(machine_named(registry, machine), version)
    computed = compute(home(), registered, without, with_)
    record = newest(registry, registered)
    payload = computed.as_dict() | {"version": registered.version, "id": record.id if record else None}

    def text() -> str:
        n = {way: sum(run["way"] == way for run in computed.runs) for way in ("without", "with")}
        return "\n".join(
            [
                table(*evidence_table(payload)),
                f"{computed.kind} evidence {payload['id']} for version {registered.version} of "
                f"{registered.machine}: {n['without']} runs without and {n['with']} with, "
                f"{computed.switches} changes between them",
                *computed.told,
                evidence_advice(payload, registered.version, registered.machine),
            ]
        )

    emit(payload, text, as_json=as_json)


@app.command()
def recheck(
    machine: Machine = None,
    without: Annotated[list[str] | None, typer.Option(help="Campaign in the lake measured without it.")] = None,
    with_: Annotated[list[str] | None, typer.Option("--with", help="Campaign measured with it.")] = None,
    blocks: Annotated[int, typer.Option(help="Passes over all circles of the cobot.", min=2, max=1000)] = 3,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the virtual machine.")] = 0,
    as_json: Json = False,
) -> None:
    """Measure with and without the champion again; when it harms, release and roll back (exit 3)."""
    from dtwin.lifecycle.recheck import recheck as check_again
    from dtwin.train.registry import Registry

    done = check_again(
        home(),
        machine_named(Registry(home()), machine),
        without=without or (),
        with_=with_ or (),
        blocks=blocks,
        seed=seed,
        progress=ProgressLine("runs", quiet=as_json),
    )
    head = ("condition", "without µm", "with µm", "growth µm", "± µm", "pairs")

    def text() -> str:
        rows = [[c.name, c.before_um, c.after_um, c.growth_um, c.half_width_um, c.pairs] for c in done.found.conditions]
        lines = [table(head, rows), f"{done.found.verdict}: {done.found.reason}"]
        if done.withdrawn:
            now = f"champion again: version {done.restored}" if done.restored else "none is served"
            lines.append(f"version {done.version.version} is withdrawn; {now}")
        return "\n".join(lines)

    emit(done.as_dict(), text, as_json=as_json)
    if done.withdrawn:
        raise typer.Exit(EXIT_GATE)
