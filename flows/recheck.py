"""Check champions again, on a schedule; one that harms is released and rolled back."""

from __future__ import annotations

from typing import Any

from prefect import flow
from prefect.client.schemas.objects import State
from prefect.states import Completed

from dtwin.config import home
from dtwin.errors import InputError
from dtwin.lifecycle.recheck import Rechecked, left_out
from dtwin.train.registry import Registry
from flows import _artifacts, _tasks


@flow(name="recheck", flow_run_name="recheck")
def recheck_flow(machine: str | None = None, seed: int = 0, blocks: int = 3) -> dict[str, Any] | State[dict[str, Any]]:
    """Measure each machine with and without its champion; withdraw the ones that harm.

    A real machine has to be measured itself: it is left out here, with that reason.
    The run ends as ``Withdrawn`` when a champion was taken away, as ``Nothing checked`` with the reasons when none could be.

    Args:
        machine: Only this one.
        seed: Seed of the virtual machine, of order and noise.
        blocks: Passes over all circles of the cobot.
    """
    registry = Registry(home())
    machines = [machine] if machine is not None else registry.machines()
    result: dict[str, Any] = {}
    withdrawn = []
    for name in machines:
        if why := left_out(registry, name):
            result[name] = {"verdict": "left out", "reason": why}
            continue
        try:
            done = _tasks.recheck(name, seed, blocks)
        except InputError as error:
            result[name] = {"verdict": "left out", "reason": error.message}
            continue
        publish_recheck(done)
        result[name] = done.as_dict()
        if done.withdrawn:
            withdrawn.append(name)
    if withdrawn:
        reason = "; ".join(result[name]["reason"] for name in withdrawn)
        return Completed(name="Withdrawn", message=reason, data=result)
    if result and all(one["verdict"] == "left out" for one in result.values()):
        reason = "; ".join(f"{name}: {one['reason']}" for name, one in result.items())
        return Completed(name="Nothing checked", message=reason, data=result)
    return result


def publish_recheck(done: Rechecked) -> None:
    """Leave the table of a check, and what came of it.

    Args:
        done: The check.
    """
    name = done.version.machine
    now = f"version {done.restored} is champion again" if done.restored else "nothing is served"
    came = f"withdrawn, {now}" if done.withdrawn else "kept"
    _artifacts.publish_table(
        f"recheck-{name}",
        ("condition", "without µm", "with µm", "growth µm", "± µm", "pairs"),
        [
            [c.name, *(f"{v:z.1f}" for v in (c.before_um, c.after_um, c.growth_um, c.half_width_um)), str(c.pairs)]
            for c in done.found.conditions
        ],
        f"Version {done.version.version}: {done.found.reason}; {came}",
    )
