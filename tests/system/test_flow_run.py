"""One real flow on a real Prefect server, started and stopped by `dtwin up`."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from running_servers import running_up

from dtwin.config import Home

pytestmark = [pytest.mark.system, pytest.mark.long]


def test_a_flow_runs_on_the_servers_that_up_started(tmp_path: Path, real_recording: Path) -> None:
    home = Home(tmp_path / "home")
    with running_up(home, "--no-schedule") as up:
        code = (
            "from pathlib import Path; from flows._runtime import run; "
            "from flows.ingest import ingest_flow; "
            f"print(run(ingest_flow, sources=[Path({str(real_recording)!r})])['added'])"
        )
        done = subprocess.run(
            [sys.executable, "-c", code],
            env=dict(os.environ, DTWIN_HOME=str(home.root)),
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr[-2000:]
        assert done.stdout.strip().endswith("2")
        (ended,) = up.runs_of("ingest")
        assert ended["state_type"] == "COMPLETED"
        assert any(a["type"] == "table" for a in up.artifacts_of(ended).values())
        assert up.stop() == 0
    assert not (home.root / "servers.json").exists()
