"""The journal outlives its session, and a disk that is full costs lines that are counted."""

from __future__ import annotations

import fcntl
import json
import os
import signal
import subprocess
import sys
import termios
import time
from array import array
from pathlib import Path
from typing import Any

import pytest

from dtwin.errors import DeviceError
from dtwin.serve import _journal
from dtwin.serve._journal import _Journal, journal


def lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def wait_for_lines(path: Path, count: int) -> list[dict[str, Any]]:
    until_s = time.monotonic() + 300.0
    while not path.exists() or len(lines(path)) < count:
        assert time.monotonic() < until_s
        time.sleep(0.01)
    return lines(path)


def waiting_bytes(pipe: int) -> int:
    held = array("i", [0])
    fcntl.ioctl(pipe, termios.FIONREAD, held)
    return held[0]


def test_events_are_there_in_order_and_the_end_has_its_reason(tmp_path: Path) -> None:
    path, said = tmp_path / "logs" / "events.jsonl", []
    with journal(path, said.append) as kept:
        kept.note("program", was="running", now="paused")
    with pytest.raises(DeviceError), journal(path, said.append):
        raise DeviceError("gone", code="ur.link_lost")
    found = [(line["event"], line.get("why", line.get("now"))) for line in lines(path)]
    assert found == [("program", "paused"), ("ended", "done"), ("ended", "ur.link_lost")]
    assert not said


def test_a_clock_that_is_set_is_noted_with_the_session(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ahead, slept = iter([5.0, 5.4, -25.0, -24.9]), iter(range(3))
    monkeypatch.setattr(_journal, "_ahead_s", lambda: next(ahead))
    monkeypatch.setattr(_journal.time, "sleep", lambda _: next(slept))
    writer = _journal._Writer(tmp_path / "events.jsonl")
    writer.session = "s"
    with pytest.raises(StopIteration):
        writer.watch_clock()
    (line,) = lines(tmp_path / "events.jsonl")
    assert (line["event"], line["session"], line["by_s"]) == ("clock_set", "s", -30.0)


def test_a_killed_session_is_noted_by_the_writer(tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    code = f"""
import time
from pathlib import Path
from dtwin.serve._journal import _Journal
_Journal(Path({str(path)!r})).note("serving", at="here")
time.sleep(60)
"""
    with subprocess.Popen([sys.executable, "-c", code]) as session:
        wait_for_lines(path, 1)
        os.kill(session.pid, signal.SIGKILL)
    first, last = wait_for_lines(path, 2)
    assert (first["event"], last["event"]) == ("serving", "killed")


def test_lines_that_found_no_room_are_counted_when_there_is_some(tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    path.symlink_to("/dev/full")
    kept = _Journal(path)
    for number in range(3):
        kept.note("guard", number=number)
    while waiting_bytes(kept._pipe):
        time.sleep(0.01)
    time.sleep(0.3)
    path.unlink()
    kept.note("guard", number=3)
    kept.close("done")
    found = lines(path)
    assert [line["event"] for line in found] == ["lines_lost", "guard", "ended"]
    assert found[0]["lines"] == 3
    assert not kept.complete
