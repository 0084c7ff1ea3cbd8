"""A virtual machine that is measured while ``dtwin serve`` corrects it."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from dtwin.commands._output import ProgressLine, emit
from dtwin.config import home
from dtwin.errors import InputError
from dtwin.kinds.machine import Request, VirtualMachine, require_no_campaign
from dtwin.kinds.registry import machines

if TYPE_CHECKING:
    from dtwin.machines.axis_server import Clock


def simulate_served(machine: VirtualMachine, request: Request, *, port: int, clock: Clock, as_json: bool) -> None:
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


def require_served(machine: VirtualMachine, port: int | None, clock: Clock) -> None:
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
