"""The command that measures campaigns on virtual machines."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dtwin.commands._output import Json, ProgressLine, emit
from dtwin.config import home
from dtwin.errors import InputError
from dtwin.kinds.machine import PLAN, Request, VirtualMachine, require_no_campaign
from dtwin.kinds.registry import machine_named, machines, own_kinds

if TYPE_CHECKING:
    from dtwin.machines.axis_server import Clock


_OWN = tuple(machines(own_kinds()))

app = typer.Typer()


def _with(option: str) -> str:
    """Return which machines have an option, for help."""
    return ", ".join(machine.name for machine in _OWN if option in machine.options)


def _values(option: str) -> str:
    """Return what each machine takes for an option, the usual first, for help."""
    known = [machine for machine in _OWN if option in machine.options]
    return "; ".join(f"{m.name}: {', '.join(m.options[option])}" for m in known)


def _clocks() -> str:
    """Return which machines can be corrected on which clocks, for help."""
    return "; ".join(f"{m.name}: {' or '.join(m.clocks)} clock" for m in _OWN if m.clocks)


@app.command()
def simulate(
    out: Annotated[Path, typer.Option(help="Campaign folder to write.")],
    machine: Annotated[str, typer.Option(help=f"Virtual machine: {', '.join(m.name for m in _OWN)}.")] = _OWN[0].name,
    plan: Annotated[
        Path | None, typer.Option(help=f"Plan file; the machine's own campaign without. Of {_with(PLAN)}.")
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="A small campaign; not with --plan.")] = False,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the machine.")] = 0,
    hidden: Annotated[str | None, typer.Option(help=f"Fault that nobody is told of. {_values('hidden')}.")] = None,
    truth: Annotated[str | None, typer.Option(help=f"What the machine is like. {_values('truth')}.")] = None,
    schedule: Annotated[str | None, typer.Option(help=f"What heats the machine. {_values('schedule')}.")] = None,
    listen: Annotated[
        int | None,
        typer.Option(
            help="Port (0: a free one) for dtwin serve --link axes, which corrects the machine while it "
            f"is measured. {_clocks()}."
        ),
    ] = None,
    wall_clock: Annotated[
        bool, typer.Option("--wall-clock", help="With --listen: in real time, not time-lapsed.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Measure a campaign on a virtual machine. Run it again to continue."""
    virtual = machine_named(machine)
    given = {PLAN: None if plan is None else str(plan), "hidden": hidden, "truth": truth, "schedule": schedule}
    clock: Clock = "wall" if wall_clock else "machine"
    if listen is not None or wall_clock:
        _require_served(virtual, listen, clock)
    options = virtual.chosen(given)
    if quick and plan is not None:
        raise InputError(
            "a plan says how much is measured",
            code="simulate.quick",
            got="--quick with --plan",
            hint="leave one of them away",
        )
    request = Request(out, seed, quick, _planned(virtual, plan), options)
    if listen is not None:
        _simulate_served(virtual, request, port=listen, clock=clock, as_json=as_json)
        return
    done = virtual.simulate(request, ProgressLine("measure", quiet=as_json))
    emit(done.payload, lambda: "\n".join(done.lines), as_json=as_json)


def _planned(machine: VirtualMachine, file: Path | None) -> Any:
    """Return the plan of a file, None without one."""
    from dtwin.plan_file import planned_campaign

    if file is None:
        return None
    planned = planned_campaign(file, machine.kind)
    if planned.kind != machine.kind:
        raise InputError(
            f"the virtual {machine.name} measures no such campaign",
            code="simulate.plan",
            where=f"{file} plan.kind",
            got=planned.kind,
            allowed=machine.kind,
        )
    return planned.plan


def _simulate_served(machine: VirtualMachine, request: Request, *, port: int, clock: Clock, as_json: bool) -> None:
    """Run a machine's program once, corrected by whoever connects, and write what was measured."""
    from dtwin.links.virtual_key import proof
    from dtwin.machines.axis_server import AxisServer

    out = request.out
    require_no_campaign(out)
    served = machine.served(request)
    state = home()
    server = AxisServer(served, lambda nonce: proof(state, nonce), clock=clock, port=port)
    try:
        server.run(_announce, ProgressLine("run", quiet=as_json))
    except KeyboardInterrupt:
        _announce("interrupted before its program had ended: nothing was written; run it again")
        raise
    finally:
        server.close()
    what = served.write(out)
    payload = {"folder": str(out), "ticks": served.ticks, "watchdog_trips": server.watchdog_trips}
    emit(payload, lambda: f"{what} in {out}\nnext: dtwin check {out}", as_json=as_json)


def _require_served(machine: VirtualMachine, port: int | None, clock: Clock) -> None:
    """Refuse a machine that cannot be corrected on a clock, and a port that is none."""
    if port is None:
        raise InputError(
            "real time is for a machine that is corrected meanwhile",
            code="simulate.clock",
            got="--wall-clock without --listen",
            allowed="--listen PORT --wall-clock",
        )
    if clock not in machine.clocks:
        able = [known for known in machines() if known.clocks]
        raise InputError(
            "this virtual machine cannot be corrected so",
            code="simulate.listen",
            got=f"--machine {machine.name}, {clock} clock",
            allowed="; ".join(f"{m.name}: {' or '.join(m.clocks)} clock" for m in able),
            hint="dtwin demo serves the virtual robot",
        )
    if not 0 <= port < 65536:
        raise InputError("no such port", code="simulate.port", got=str(port), allowed="0 to 65535, 0: a free one")


def _announce(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
