"""The command that computes closed-loop evidence from runs: evidence."""

from __future__ import annotations

from typing import Annotated

import typer

from dtwin.commands._models import Machine, machine_named
from dtwin.commands._output import Json, emit
from dtwin.config import home
from dtwin.errors import InputError
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
