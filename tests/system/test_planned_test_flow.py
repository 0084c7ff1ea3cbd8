"""A test planned in the browser, measured on the virtual mill by the flow, and compared with the last one."""

from __future__ import annotations

import json
import re
import time
from pathlib import Path

import pytest
from workbench_server import running_workbench

from dtwin.acquire.ingest import ingest
from dtwin.acquire.virtual_mill import simulate_mill
from dtwin.config import Home
from dtwin.lake.store import Lake

pytestmark = [pytest.mark.system, pytest.mark.long]


def test_the_form_of_a_virtual_machine_ends_with_what_changed(tmp_path: Path) -> None:
    home = Home(tmp_path / "home")
    simulate_mill(tmp_path / "mill", quick=True)
    ingest(tmp_path / "mill", Lake(home.lake))
    query = "kind=circular&name=again&radius_mm=50&feed_mm_min=1000,2000&repeats=2"
    with running_workbench(home.root) as bench:
        status, page = bench.ask(f"/machines/virtual-mill/plan?{query}", cookie=bench.cookie)
        assert status == 200
        assert "Measure it on the virtual mill" in page
        status, answer = bench.act("/api/machines/virtual-mill/plans", json.dumps({"query": query}).encode())
        assert status == 202, answer
        job = {"state": "waiting"}
        while job["state"] not in ("done", "failed"):
            time.sleep(0.2)
            job = json.loads(bench.ask(f"/api/jobs/{json.loads(answer)['job']}", cookie=bench.cookie)[1])
        assert job["state"] == "done", job["error"]
        assert job["address"] == "/machines/virtual-mill/changes?campaign=again"
        changes = bench.ask(job["address"], cookie=bench.cookie)[1]
        machine = bench.ask("/machines/virtual-mill", cookie=bench.cookie)[1]
    rows = Lake(home.lake).runs("again")
    assert {(row["radius_mm"], row["feed_mm_min"]) for row in rows} == {(50.0, 1000.0), (50.0, 2000.0)}
    assert len(rows) == 8
    assert "mill-backlash" in changes
    # The same machine, with other noise: what its shape is did not change.
    assert re.search(r'G\(b\).*?XY R50 F1000.*?"tag good">not changed<', changes, re.DOTALL)
    assert "again beside mill-backlash" in machine
