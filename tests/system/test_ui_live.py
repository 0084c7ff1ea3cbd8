"""The live page against a process that really holds a machine's lease."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Iterator

import pytest
from workbench_server import Workbench, running_workbench

pytestmark = [pytest.mark.system, pytest.mark.timeout(120)]

SERVES = """
import sys, time
from pathlib import Path
from dtwin.config import Home
from dtwin.serve.lease import lease
from dtwin.serve.signals import stop_on_signals
with lease("127.0.0.1", "mill-a", Home(Path(sys.argv[1]))), stop_on_signals() as asked:
    print("serving", flush=True)
    while not asked():
        time.sleep(0.01)
print("released", flush=True)
"""


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Workbench]:
    with running_workbench(tmp_path_factory.mktemp("live")) as started:
        yield started


def test_what_serves_is_shown_and_stopped(bench: Workbench) -> None:
    assert "Nothing is being served" in bench.ask("/live")[1]
    serving = subprocess.Popen(
        [sys.executable, "-c", SERVES, str(bench.home)], stdout=subprocess.PIPE, text=True
    )
    try:
        assert serving.stdout is not None
        assert serving.stdout.readline() == "serving\n"
        (found,) = json.loads(bench.ask("/api/live")[1])["serving"]
        assert (found["machine"], found["pid"]) == ("mill-a", serving.pid)
        assert "mill-a is being corrected" in bench.ask("/live")[1]
        assert bench.ask("/api/live/mill-a/stop", method="POST", body=b"{}")[0] == 403
        assert serving.poll() is None
        assert bench.act("/api/live/other/stop")[0] == 400
        assert bench.act("/api/live/mill-a/stop")[0] == 200
        assert serving.stdout.read() == "released\n"
        assert serving.wait(10) == 0
    finally:
        if serving.poll() is None:
            serving.send_signal(signal.SIGKILL)
        serving.wait()
    assert json.loads(bench.ask("/api/live")[1])["serving"] == []


def test_a_session_that_ended_shows_its_figures(bench: Workbench) -> None:
    log = bench.home / "logs" / "serve-mill-a.jsonl"
    log.parent.mkdir(exist_ok=True)
    percentiles = {"p50": 2.0, "p99": 2.5, "p99.9": 3.0, "max": 4.0}
    session = {
        "started": "2026-03-02T08:00:00+00:00", "duration_s": 22.0, "machine": "mill-a",
        "model": {"version": 3}, "host": "127.0.0.1", "device": "virtual", "trial": False,
        "clamp_um": 93.0, "clock": "wall", "mode": "live", "ended": "duration", "released": True,
        "reasons": {"ok": 990, "clamped": 7, "slew_limited": 3}, "largest_um": 93.0, "fault": None,
        "timing": {
            "ticks": 1000, "late_ticks": 3, "missed_states": 1, "timeouts": 0, "late_share": 0.004,
            "period_ms": percentiles, "state_age_ms": percentiles,
            "jitter_us_histogram": {"<10": 900, ">=10": 100},
        },
    }  # fmt: skip
    log.write_text("cut off}\n" + json.dumps(session) + "\n", encoding="utf-8")
    text = bench.ask("/live")[1]
    assert "clamped 7, slew limited 3" in text
    assert "0.40 <small>%, 3 late, 1 missed" in text
    figure = json.loads(bench.ask("/api/live/mill-a/0/jitter")[1])
    assert figure["data"][0]["x"] == ["<10", ">=10"]
