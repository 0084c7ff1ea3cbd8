"""The flow that computes the ball-bar paper's table again, on a real Prefect server."""

from __future__ import annotations

import json

import pytest
from running_servers import Up

from flows._runtime import delivered, run
from flows.papers import dynamics_paper_flow
from studies import dynamics_paper
from studies.dynamics_paper import Size

pytest_plugins = ["shared_up"]
pytestmark = pytest.mark.system


@pytest.mark.long
def test_the_table_is_published(shared_up: Up, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DTWIN_HOME", str(shared_up.home.root))
    small = Size(("sim2",), (0.0, 5.0), (1200.0, 6000.0), 4, 4)
    monkeypatch.setattr(dynamics_paper, "QUICK", small)
    with delivered():
        found = run(dynamics_paper_flow, quick=True)
    (seen,) = shared_up.runs_of("dynamics-paper")
    assert seen["state"]["name"] == "Completed"
    table = json.loads(shared_up.artifacts_of(seen)["dynamics-paper"]["data"])
    assert [row["figure"] for row in table] == [line["what"] for line in found["lines"]]
    assert {row["answer"] for row in table} == {"follows", "does not", "calibrated", "not judged"}
