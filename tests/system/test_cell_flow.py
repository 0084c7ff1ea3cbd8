"""The cell's flow on a real Prefect server: tasks, table, stop and resume."""

from __future__ import annotations

import json
from typing import Any

import pytest
from command_here import said
from running_servers import Up, wait_for

from dtwin.config import home
from flows import _tasks
from flows._runtime import delivered, run
from flows.cell import cell_flow
from studies.cell import status
from studies.cell_state import DONE, STEPS, CellFile

pytest_plugins = ["shared_up"]
pytestmark = pytest.mark.system


@pytest.fixture
def up(shared_up: Up, monkeypatch: pytest.MonkeyPatch) -> Up:
    monkeypatch.setenv("DTWIN_HOME", str(shared_up.home.root))
    return shared_up


def task_names(up: Up, flow_run: dict[str, Any]) -> list[str]:
    """Names of the tasks that the server knows of; it records them some time after they ran."""
    wanted = {"task_runs": {"flow_run_id": {"any_": [flow_run["id"]]}}}
    return sorted(task["name"] for task in up.ask("/task_runs/filter", wanted))


def test_a_stopped_job_shows_on_the_page_and_resumes(up: Up, monkeypatch: pytest.MonkeyPatch) -> None:
    file, real = CellFile(home(), "tested"), _tasks.cell.do_step

    def and_ask(step: str, part: int, twin: str, seed: int) -> dict[str, object]:
        if step == "mill quarter 2":
            file.ask_to_stop("the operator wants to look")
        return real(step, part, twin, seed)

    monkeypatch.setattr(_tasks.cell, "do_step", and_ask)
    with delivered():
        run(cell_flow, cell="tested")
    assert status(file)["condition"] == "stopped"
    monkeypatch.setattr(_tasks.cell, "do_step", real)
    with delivered():
        run(cell_flow, cell="tested", resume=True)
    stopped, resumed = up.runs_of("cell")
    assert (stopped["state"]["name"], resumed["state"]["name"]) == ("Stopped", "Completed")
    assert "wants to look" in stopped["state"]["message"]
    steps = [f"part 1: {step}" for step, _ in STEPS]
    wait_for(
        lambda: [task_names(up, each) for each in (stopped, resumed)] == [sorted(steps[:4]), sorted(steps[4:])],
        message=f"the server has not recorded these tasks: {steps}",
    )
    table = json.loads(up.artifacts_of(resumed)["cell-tested"]["data"])
    assert [row["state"] for row in table] == [DONE] * len(STEPS)
    shown = said("cell", "status", "--cell", "tested")
    assert (shown["condition"], shown["done_steps"], shown["live_twin"]) == ("done", 8, "none")
