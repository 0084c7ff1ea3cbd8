"""A virtual machine that is measured while ``dtwin serve`` corrects it."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Protocol

from dtwin.commands.output import ProgressLine, emit
from dtwin.config import home
from dtwin.errors import InputError
from dtwin.links.virtual_key import proof
from dtwin.machines.axis_server import AxisMachine, AxisServer, Clock

MACHINES = ("lathe", "turning", "volumetric")


class ServedMachine(AxisMachine, Protocol):
    """A machine whose measurements become a campaign folder."""

    def write(self, folder: Path) -> str:
        """Write what was measured; return what it was."""
        ...


def simulate_served(
    out: Path, machine: str, plan: Path | None, truth: str | None, schedule: str, *, seed: int,
    quick: bool, port: int | None, clock: Clock, as_json: bool,
) -> None:  # fmt: skip
    """Run a machine's program once, corrected by whoever connects, and write what was measured."""
    _require(machine, port, clock)
    if (out / "campaign.toml").exists():
        raise InputError(
            "the folder holds a campaign already", code="simulate.exists", where=str(out),
            hint="give another --out",
        )  # fmt: skip
    served = _machine(machine, plan, truth, schedule, seed=seed, quick=quick)
    state = home()
    server = AxisServer(served, lambda nonce: proof(state, nonce), clock=clock, port=port or 0)
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


def _require(machine: str, port: int | None, clock: Clock) -> None:
    if port is None:
        raise InputError(
            "real time is for a machine that is corrected meanwhile", code="simulate.clock",
            got="--wall-clock without --listen", allowed="--listen PORT --wall-clock",
        )  # fmt: skip
    if machine not in MACHINES or (machine != "lathe" and clock == "wall"):
        raise InputError(
            "this virtual machine cannot be corrected so", code="simulate.listen",
            got=f"--machine {machine}, {clock} clock",
            allowed="lathe on both clocks; turning (8 kHz) and volumetric (days) on the machine clock",
            hint="dtwin demo serves the virtual robot",
        )  # fmt: skip
    if not 0 <= port < 65536:
        raise InputError(
            "no such port", code="simulate.port", got=str(port), allowed="0 to 65535, 0: a free one"
        )


def _machine(
    machine: str, plan: Path | None, truth: str | None, schedule: str, *, seed: int, quick: bool
) -> ServedMachine:
    if machine == "lathe":
        from dtwin.acquire.served_lathe import ServedLathe
        from dtwin.linear_plan import read_linear_plan

        return ServedLathe(read_linear_plan(plan) if plan else None, truth or "published", seed)
    if machine == "turning":
        from dtwin.acquire.served_slide import ServedSlide, tone_check
        from dtwin.plan_file import planned_campaign

        tones = planned_campaign(plan).plan if plan else tone_check(quick=quick)
        return ServedSlide(tones, truth or "linear", seed)
    from dtwin.acquire.served_mill import ServedMill
    from dtwin.plan_file import planned_campaign

    balls = planned_campaign(plan).plan if plan else None
    return ServedMill(balls, truth or "surface", schedule, seed, quick=quick)


def _announce(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
