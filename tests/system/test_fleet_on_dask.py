"""A fleet on real workers of a real Dask scheduler, of which one and then the other is killed."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from fleet_lake import fill

from dtwin.config import Home, home
from dtwin.errors import StoreError
from dtwin.fleet.jobs import DIAGNOSE
from dtwin.fleet.run import run_fleet

pytestmark = pytest.mark.system
CAMPAIGNS = 7


class Plant:
    """A scheduler and two workers."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.processes = folder, dict[str, subprocess.Popen[bytes]]()
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.address = f"127.0.0.1:{free.getsockname()[1]}"

    def start(self) -> None:
        port = self.address.rpartition(":")[2]
        self._start("scheduler", "scheduler", "--port", port)
        for name in ("one", "two"):
            self._start(name, "worker", f"tcp://{self.address}", "--nthreads", "1", "--no-nanny", "--name", name)
        self.wait(lambda: self.log("scheduler").count("Register worker") == 2)

    def _start(self, name: str, *words: str) -> None:
        command = [sys.executable, "-m", "dask", *words, "--host", "127.0.0.1", "--no-dashboard"]
        with (self.folder / f"{name}.log").open("wb") as log:
            self.processes[name] = subprocess.Popen(
                command,
                stdout=log,
                stderr=subprocess.STDOUT,
                cwd=self.folder,
                env=os.environ | {"OMP_NUM_THREADS": "1"},
            )

    def log(self, name: str) -> str:
        return (self.folder / f"{name}.log").read_text()

    def kill(self, name: str) -> None:
        self.processes[name].send_signal(signal.SIGKILL)
        self.processes[name].wait()

    def wait(self, done: Callable[[], bool]) -> None:
        until = time.monotonic() + 300.0
        while not done():
            assert time.monotonic() < until, self.log("scheduler")
            time.sleep(0.05)


@pytest.fixture
def plant(tmp_path: Path) -> Iterator[Plant]:
    made = Plant(tmp_path)
    try:
        made.start()
        yield made
    finally:
        for name in made.processes:
            with suppress(ProcessLookupError):
                made.kill(name)


def _kept(where: Home) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in (where.root / "kept" / "diagnoses").glob("*")}


def test_a_worker_and_then_the_scheduler_is_killed_and_nothing_is_lost_or_done_twice(
    plant: Plant, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fill(home(), CAMPAIGNS)
    at = f"dask://{plant.address}"
    done: list[str] = []

    def killing(count: int, total: int, what: str) -> None:
        done.append(what)
        if len(done) == 2:
            plant.kill("one")
        if len(done) == 4:
            plant.kill("scheduler")

    monkeypatch.setattr("dtwin.fleet.run._CONNECT_S", 2)
    with pytest.raises(StoreError) as caught:
        run_fleet(home(), DIAGNOSE, on=at, progress=killing)
    assert caught.value.code == "fleet.died"
    kept = _kept(home())
    assert caught.value.got == f"{len(kept)} of {CAMPAIGNS} are done and kept"
    assert 4 <= len(kept) < CAMPAIGNS
    assert len(set(done)) == len(done) == len(kept)
    # The rest in line: what was kept is not done again, and all is what one process finds.
    rest = run_fleet(home(), DIAGNOSE, workers=1)
    assert len(rest.done) == CAMPAIGNS - len(kept)
    assert {name: _kept(home())[name] for name in kept} == kept
    other = Home(tmp_path / "other")
    fill(other, CAMPAIGNS)
    run_fleet(other, DIAGNOSE, workers=1)
    assert _kept(home()) == _kept(other)
