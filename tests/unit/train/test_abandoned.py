from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from dtwin.config import Home
from dtwin.processes import is_gone, process
from dtwin.train.registry import Registry

_KILLED = """
import os, sys
from pathlib import Path
from dtwin.config import Home
from dtwin.train.registry import Registry
with Registry(Home(Path(sys.argv[1]))).open_run("training", {}):
    os.kill(os.getpid(), 9)
"""


def test_a_process_is_told_from_a_later_one_with_its_number() -> None:
    mine = process()
    assert not is_gone(mine)
    host, number, start = mine.split()
    assert is_gone(f"{host} {number} {int(start) - 1}")
    assert is_gone(f"{host} 4194305 17")
    assert not is_gone(f"elsewhere {number} 1")
    assert not is_gone("")


def test_a_killed_training_is_closed_and_a_running_one_is_not(tmp_path: Path) -> None:
    home = Home(tmp_path)
    assert subprocess.run([sys.executable, "-c", _KILLED, str(tmp_path)], check=False).returncode == -9
    registry = Registry(home)
    with registry.open_run("mine", {}) as mine:
        assert registry.close_abandoned() == 1
        states = {r.info.run_name: r.info.status for r in registry.client.search_runs([registry.experiment()])}
        assert states == {"training": "KILLED", "mine": "RUNNING"}
    assert registry.client.get_run(mine).info.status == "FINISHED"
    assert registry.close_abandoned() == 0
