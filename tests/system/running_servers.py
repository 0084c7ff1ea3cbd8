"""``dtwin up`` as a process, for the tests of what it serves."""

from __future__ import annotations

import base64
import json
import os
import select
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from dtwin.acquire.runner import run_campaign
from dtwin.acquire.virtual import VirtualCobotBench
from dtwin.config import Home
from dtwin.machines.cobot import VirtualCobot
from dtwin.pipeline.measuring import ingest
from dtwin.plan import quick_training_plan
from dtwin.train.symbolic import OperonEngine

MACHINE = "virtual-cobot"
PATIENCE_S = 600.0


class Up:
    """Handle of a running ``dtwin up``."""

    def __init__(self, home: Home, process: subprocess.Popen[str]) -> None:
        self.home = home
        self.process = process
        self.addresses: dict[str, Any] = {}

    def await_addresses(self) -> None:
        assert self.process.stdout is not None
        ready, _, _ = select.select([self.process.stdout], [], [], PATIENCE_S)
        text = ""
        while ready and not text.rstrip().endswith("}"):
            line = self.process.stdout.readline()
            if not line:
                break
            text += line
        assert text, self.complaint()
        self.addresses = json.loads(text)

    def complaint(self) -> str:
        self.process.kill()
        assert self.process.stderr is not None
        return self.process.stderr.read()

    def stop(self) -> int:
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
        return self.process.wait(300)

    def ask(self, path: str, body: dict[str, Any], **headers: str) -> Any:
        secret = base64.b64encode((self.home.root / "prefect-auth").read_bytes()).decode()
        request = urllib.request.Request(
            self.addresses["prefect_api"] + path,
            json.dumps(body).encode(),
            {"content-type": "application/json", "Authorization": f"Basic {secret}"} | headers,
        )
        # Prefect's server answers 503 while its database is locked for longer than it waits, and its own
        # clients then ask again.
        for _ in range(5):
            try:
                with urllib.request.urlopen(request, timeout=120) as reply:
                    return json.load(reply)
            except urllib.error.HTTPError as refused:
                if refused.code != 503:
                    raise
                time.sleep(2.0)
        raise AssertionError(f"the server stays busy: {path}")

    def runs_of(self, flow: str) -> list[dict[str, Any]]:
        """Runs of a flow that have ended, oldest first."""
        wanted = {
            "flows": {"name": {"any_": [flow]}},
            "flow_runs": {"state": {"type": {"any_": ["COMPLETED", "FAILED", "CRASHED"]}}},
            "sort": "START_TIME_ASC",
        }
        found: list[dict[str, Any]] = self.ask("/flow_runs/filter", wanted)
        return found

    def artifacts_of(self, run: dict[str, Any]) -> dict[str, dict[str, Any]]:
        wanted = {"artifacts": {"flow_run_id": {"any_": [run["id"]]}}}
        return {found["key"]: found for found in self.ask("/artifacts/filter", wanted)}


@contextmanager
def running_up(home: Home, *options: str) -> Iterator[Up]:
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PREFECT_")}
    process = subprocess.Popen(
        [sys.executable, "-m", "dtwin", "up", "--json", *options],
        env=environment | {"DTWIN_HOME": str(home.root), "OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    up = Up(home, process)
    try:
        up.await_addresses()
        yield up
    finally:
        up.stop()
        for stream in (process.stdout, process.stderr):
            if stream is not None:
                stream.close()


def wait_for(what: Callable[[], Any], message: str) -> Any:
    """The first true answer; fails the test when there is none in ten minutes, which only what hangs takes."""
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        found = what()
        if found:
            return found
        time.sleep(1.0)
    raise AssertionError(message)


# The search for a symbolic equation, at its shortest: it takes part in the training, and finds nothing.
SHORT_SEARCH = OperonEngine(generations=1, population=20)


@contextmanager
def few_candidates() -> Iterator[None]:
    """Train with a short search, and without most comparison models: these take three quarters of a training's time.

    The demo of test_pipeline searches, and compares all of them.
    """
    from dtwin.kinds.circular._training import RECIPES, train_campaign

    assert train_campaign.__kwdefaults__["recipes"] is RECIPES
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(train_campaign.__kwdefaults__, "recipes", [r for r in RECIPES if r.name in ("linear", "tree")])
        patch.setattr("dtwin.kinds.circular._training.OperonEngine", lambda: SHORT_SEARCH)
        yield


def measured(home: Home, name: str, *, repeats_from: int = 0, worn: float = 1.0, radii: int = 3) -> Path:
    """A quick campaign of the virtual cobot in the lake, with other noise, or with worn joints.

    Of two of its three radii it takes half the time to train.
    """
    plan = quick_training_plan()
    smallest = sorted({test.radius_mm for test in plan.tests})[:radii]
    tests = tuple(replace(test, repeat=test.repeat + repeats_from) for test in plan.tests if test.radius_mm in smallest)
    bench = VirtualCobotBench(0)
    if worn != 1.0:
        sound = bench.cobot.parameters
        joints = replace(
            sound.joints,
            play_width_urad=tuple(worn * play for play in sound.joints.play_width_urad),
            friction_urad=tuple(worn * lost for lost in sound.joints.friction_urad),
        )
        bench.cobot = VirtualCobot(replace(sound, joints=joints), seed=0)
    folder = home.campaigns / name
    run_campaign(replace(plan, name=name, tests=tests), bench, folder)
    ingest(folder, home)
    return folder
