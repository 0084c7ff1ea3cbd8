"""The control twin: one flow over both machines of the cell."""

from __future__ import annotations

from typing import Any

from prefect import flow
from prefect.client.schemas.objects import State
from prefect.states import Completed

from dtwin.config import home
from flows import _artifacts, _tasks
from studies.cell import run_job, status, step_rows
from studies.cell_state import DONE, CellFile


@flow(name="cell", flow_run_name="cell {cell}")
def cell_flow(
    cell: str = "demo", parts: int = 1, seed: int = 0, resume: bool = False
) -> dict[str, Any] | State[dict[str, Any]]:
    """Take parts through the virtual cell: load, hold, mill four quarters, unload.

    Every step is a task, and only its machine's twin is live. The run ends as ``Stopped`` when
    somebody asked for it; with ``resume`` a later run goes on with the first step not done.

    Args:
        cell: Name of the cell; its state is below ``DTWIN_HOME/cells``.
        parts: Parts of a new job.
        seed: Of both virtual machines.
        resume: Go on with the job that is there.
    """
    file = CellFile(home(), cell)
    if not resume:
        file.begin(parts, seed)
    seed = int(file.read()["seed"])

    def do(step: str, part: int, twin: str) -> dict[str, Any]:
        return _tasks.cell_step(step, part, twin, seed)

    outcome = run_job(file, do)
    seen = status(file)
    _publish(cell, seen, outcome.stopped)
    if outcome.stopped:
        return Completed(name="Stopped", message=outcome.stopped, data=seen)
    return seen


def _publish(cell: str, seen: dict[str, Any], stopped: str) -> None:
    rows = step_rows(seen)
    done = sum(s["state"] == DONE for s in seen["steps"])
    came = f"stopped: {stopped}" if stopped else "done"
    _artifacts.publish_table(
        f"cell-{cell}",
        ("part", "step", "live twin", "state", "s", "error without, µm", "error, µm"),
        rows,
        f"{done} of {len(rows)} steps; {came}",
    )
