"""One real flow on a real Prefect server, started and stopped by `dtwin up`."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
import urllib.request
from pathlib import Path
from typing import Any

import pytest

pytestmark = [pytest.mark.system, pytest.mark.long]


def ask(url: str, body: dict[str, Any]) -> list[dict[str, Any]]:
    request = urllib.request.Request(
        url, json.dumps(body).encode(), {"Content-Type": "application/json"}
    )
    with urllib.request.urlopen(request, timeout=20) as answer:
        found: list[dict[str, Any]] = json.load(answer)
    return found


def test_a_flow_runs_on_the_servers_that_up_started(tmp_path: Path, real_recording: Path) -> None:
    home = tmp_path / "home"
    environment = dict(os.environ, DTWIN_HOME=str(home))
    log = (tmp_path / "up.log").open("wb")
    up = subprocess.Popen(
        [sys.executable, "-m", "dtwin", "up", "--no-schedule"],
        env=environment, stdout=log, stderr=subprocess.STDOUT,
    )  # fmt: skip
    where = home / "servers.json"
    try:
        until = time.monotonic() + 150
        while not where.exists() and up.poll() is None and time.monotonic() < until:
            time.sleep(0.5)
        assert where.exists(), (tmp_path / "up.log").read_text()
        servers = json.loads(where.read_text())
        assert servers["prefect"].startswith("http://127.0.0.1:")
        code = (
            "from pathlib import Path; from flows._runtime import run; "
            "from flows.ingest import ingest_flow; "
            f"print(run(ingest_flow, sources=[Path({str(real_recording)!r})])['added'])"
        )
        done = subprocess.run(
            [sys.executable, "-c", code],
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr[-2000:]
        assert done.stdout.strip().endswith("2")
        runs = ask(f"{servers['prefect_api']}/flow_runs/filter", {})
        assert [run["state_type"] for run in runs] == ["COMPLETED"]
        kinds = {a["type"] for a in ask(f"{servers['prefect_api']}/artifacts/filter", {})}
        assert "table" in kinds
        with urllib.request.urlopen(servers["mlflow"] + "/health", timeout=20) as answer:
            assert answer.status == 200
    finally:
        up.send_signal(signal.SIGINT)
        up.wait(60)
        log.close()
    assert not where.exists()
