"""The cell's job: order, live twin, stop, resume, and what a killed process leaves."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import time
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from dtwin.config import Home
from dtwin.errors import InputError, StoreError
from studies.cell import do_step, run_job, status
from studies.cell_state import COBOT, MILL, NONE, STEPS, CellFile


@pytest.fixture
def cell(tmp_path: Path) -> CellFile:
    return CellFile(Home(tmp_path), "a")


def test_only_the_twin_of_the_running_step_is_live_and_steps_come_in_order(cell: CellFile) -> None:
    cell.begin(2, 0)
    seen: list[tuple[int, str, str]] = []

    def do(step: str, part: int, twin: str) -> dict[str, Any]:
        now = status(cell)
        assert (now["condition"], now["live_twin"], now["next"]) == ("running", twin, step)
        seen.append((part, step, twin))
        return {}

    assert run_job(cell, do).stopped == ""
    assert seen == [(part, step, twin) for part in (1, 2) for step, twin in STEPS]
    assert {twin for _, _, twin in seen} == {COBOT, MILL, NONE}
    after = status(cell)
    assert (after["condition"], after["live_twin"], after["next"]) == ("done", NONE, None)


def test_a_stop_comes_after_the_step_and_a_resume_goes_on_with_the_next(cell: CellFile) -> None:
    cell.begin(1, 0)
    done: list[str] = []

    def do(step: str, part: int, twin: str) -> dict[str, Any]:
        done.append(step)
        if step == "mill quarter 2":
            cell.ask_to_stop("lunch")
        return {}

    outcome = run_job(cell, do)
    assert (outcome.stopped, done[-1]) == ("lunch", "mill quarter 2")
    assert status(cell)["condition"] == "stopped"
    with pytest.raises(InputError, match="not done"):
        cell.begin(1, 0)
    assert run_job(cell, do).stopped == ""
    assert done == [step for step, _ in STEPS]


def test_a_step_that_fails_is_done_again(cell: CellFile) -> None:
    cell.begin(1, 0)
    failed: list[str] = []

    def do(step: str, part: int, twin: str) -> dict[str, Any]:
        if step == "mill quarter 1" and not failed:
            failed.append(step)
            raise RuntimeError("spindle")
        return {"by": step}

    with pytest.raises(RuntimeError, match="spindle"):
        run_job(cell, do)
    entry = status(cell)["steps"][2]
    assert (entry["state"], entry["result"]) == ("interrupted", {})
    run_job(cell, do)
    assert all(s["result"] == {"by": s["step"]} for s in status(cell)["steps"])


def test_a_killed_job_is_stopped_with_no_twin_live_and_its_step_is_done_again(cell: CellFile, tmp_path: Path) -> None:
    cell.begin(1, 0)
    code = (
        "import sys, time; from pathlib import Path; from dtwin.config import Home;"
        "from studies.cell import run_job; from studies.cell_state import CellFile\n"
        "def do(step, part, twin):\n"
        "    if step == 'mill quarter 3':\n"
        "        print('milling', flush=True); time.sleep(60)\n"
        "    return {}\n"
        "run_job(CellFile(Home(Path(sys.argv[1])), 'a'), do)"
    )
    process = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "milling\n"
    while_running = status(cell)
    assert (while_running["condition"], while_running["live_twin"]) == ("running", MILL)
    with pytest.raises(InputError, match="running already"):
        run_job(cell)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    process.stdout.close()
    until = time.monotonic() + 300.0
    while status(cell)["condition"] == "running" and time.monotonic() < until:
        time.sleep(0.05)
    left = status(cell)
    assert (left["condition"], left["live_twin"]) == ("stopped", NONE)
    again: list[str] = []
    run_job(cell, lambda step, part, twin: again.append(step) or {})  # type: ignore[func-returns-value]
    assert again == ["mill quarter 3", "mill quarter 4", "to unload position", "unload"]


def test_a_step_with_another_twin_and_a_damaged_state_are_refused(cell: CellFile) -> None:
    with pytest.raises(InputError, match="no such step"):
        do_step("load", 1, MILL, 0)
    with pytest.raises(InputError, match="no job"):
        cell.read()
    with pytest.raises(InputError, match="one part or more"):
        cell.begin(0, 0)
    cell.begin(1, 0)
    (cell.folder / "state.json").write_text("{")
    with pytest.raises(StoreError, match="cannot be read"):
        status(cell)
    cell.clear()
    with pytest.raises(InputError, match="no job"):
        cell.read()


def test_both_twins_make_their_step_better() -> None:
    for step, twin in (("load", COBOT), ("mill quarter 3", MILL)):
        result = do_step(step, 1, twin, 0)
        assert result["error_um"] < 0.3 * result["error_without_um"], step
    unloaded = do_step("unload", 1, COBOT, 0)
    assert unloaded["error_um"] < 30.0


def test_a_mistake_in_a_flow_is_logged_without_a_traceback() -> None:
    import_module("flows._told")
    for error, kept in ((InputError("the cell has no job"), False), (ValueError("ours"), True)):
        record = logging.LogRecord("prefect.flow_runs", logging.ERROR, "", 1, "", (), (type(error), error, None))
        assert logging.getLogger("prefect.flow_runs").filter(record)
        assert bool(record.exc_info) is kept
