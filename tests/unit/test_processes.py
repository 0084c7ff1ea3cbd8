from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections import OrderedDict
from pathlib import Path

import numpy as np
import pytest

from dtwin.physics import _kept_columns
from dtwin.physics.effect import Instance
from dtwin.physics.library import Library
from dtwin.processes import give_back_memory, interruptible, is_gone, process


def test_a_process_is_told_from_a_later_one_with_its_number(monkeypatch: pytest.MonkeyPatch) -> None:
    mine = process()
    assert not is_gone(mine)
    host, number, start = mine.split()
    assert is_gone(f"{host} {number} {int(start) - 1}")
    assert is_gone(f"{host} 4194305 17")
    assert not is_gone(f"elsewhere {number} 1")
    assert not is_gone("")
    # Of another computer with the same name nothing is known.
    monkeypatch.setattr("dtwin.processes._computer", lambda: "another")
    assert not is_gone(f"{host} 4194305 17")


_POOL = """
import os, signal
from concurrent.futures import ProcessPoolExecutor
from dtwin.processes import end_with, process

def work(_):
    os.write(1, f"{process()}\\n".encode())
    signal.pause()

with ProcessPoolExecutor(2, initializer=end_with, initargs=(os.getpid(),)) as pool:
    list(pool.map(work, range(2)))
"""


def test_workers_of_a_pool_end_with_a_process_that_is_killed() -> None:
    with subprocess.Popen([sys.executable, "-c", _POOL], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as parent:
        assert parent.stdout is not None
        workers = [parent.stdout.readline().decode().strip() for _ in range(2)]
        there = not any(map(is_gone, workers))
        parent.kill()
        assert there
        for _ in range(2000):
            if all(map(is_gone, workers)):
                break
            time.sleep(0.01)
        assert all(map(is_gone, workers))


def test_a_process_that_ended_is_gone_though_nobody_asked_for_its_exit_code() -> None:
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as child:
        there = process(child.pid)
        assert not is_gone(there)
        child.kill()
        os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)
        assert is_gone(there)


def _resident_mb() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def test_what_a_computation_has_left_free_goes_back_to_the_system() -> None:
    pieces = [bytearray(b"x") * 50_000 for _ in range(4000)]
    held_mb, last = _resident_mb(), pieces[-1]
    pieces.clear()
    give_back_memory()
    assert _resident_mb() < held_mb - 150.0
    assert len(last) == 50_000


def test_columns_are_kept_up_to_so_many_bytes_and_the_newest_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("_kept", OrderedDict()), ("_held_bytes", 0), ("_MOST_BYTES", 100_000)):
        monkeypatch.setattr(_kept_columns, name, value)
    instance = Instance(Library()["backlash"], "X")
    for times in range(2):
        for condition in range(20):
            kept = _kept_columns.kept_columns(instance, {}, condition, lambda: np.zeros((360, 10)))
            assert kept is _kept_columns.kept_columns(instance, {}, condition, lambda: np.ones((360, 10)))
        # Three of 28.8 kB and what is told beside them.
        assert [key[-1] for key in _kept_columns._kept] == [17, 18, 19], times


def test_ctrl_c_does_not_wait_for_a_call_that_does_not_hear_it() -> None:
    """As of a store that took the connection and is frozen: its library waits outside of Python."""
    # A shell's background job is begun with Ctrl-C ignored, and so would its children be.
    hears = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
    waits = "import ctypes; from dtwin.processes import interruptible; print(1, flush=True); "
    call = "interruptible(lambda: ctypes.CDLL(None).poll(None, 0, 3_600_000))"
    with subprocess.Popen(
        [sys.executable, "-c", hears + waits + call], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as child:
        assert child.stdout is not None
        child.stdout.readline()
        time.sleep(0.5)
        child.send_signal(signal.SIGINT)
        _, said = child.communicate(timeout=60.0)
    assert b"KeyboardInterrupt" in said
    assert interruptible(lambda: 3) == 3
    with pytest.raises(KeyError):
        interruptible(lambda: {}[1])


def test_what_goes_on_in_the_background_ends_when_its_home_has_vanished(tmp_path: Path) -> None:
    begins = f"from pathlib import Path; from dtwin.twins._background import _end_without; _end_without(Path({str(tmp_path / 'home')!r}))"
    (tmp_path / "home").mkdir()
    with subprocess.Popen([sys.executable, "-c", begins]) as child:
        with pytest.raises(subprocess.TimeoutExpired):
            child.wait(1.0)
        (tmp_path / "home").rmdir()
        assert child.wait(60.0) == 1
