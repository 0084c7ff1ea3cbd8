"""The lease on a robot, held by real processes."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from dtwin.config import Home
from dtwin.errors import EXIT_DEVICE, DeviceError, InputError, StoreError
from dtwin.locks import take
from dtwin.serve import _lease
from dtwin.serve._lease import lease

ROBOT = "127.0.0.1"


@pytest.fixture
def home(tmp_path: Path) -> Home:
    return Home(tmp_path / "home")


@contextmanager
def held_elsewhere(home: Home, host: str, machine: str) -> Iterator[subprocess.Popen[str]]:
    """Another process that holds the lease until it is ended."""
    code = f"""
import pathlib, sys
from dtwin.config import Home
from dtwin.serve._lease import lease
with lease({host!r}, {machine!r}, Home(pathlib.Path({str(home.root)!r}))):
    print("held", flush=True)
    sys.stdin.read()
"""
    process = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        assert process.stdout.readline() == "held\n"
        yield process
    finally:
        process.stdin.close()
        process.wait(300)
        process.stdout.close()


def test_second_server_is_refused_and_told_who_holds_it(home: Home) -> None:
    with held_elsewhere(home, ROBOT, "cobot-a") as other:
        with pytest.raises(DeviceError, match="is served already") as refused, lease(ROBOT, "cobot-a", home):
            raise AssertionError("two servers of one robot")
        assert refused.value.exit_code == EXIT_DEVICE
        assert str(other.pid) in (refused.value.got or "")
    with lease(ROBOT, "cobot-a", home):
        pass


def test_who_only_asks_whether_a_machine_is_held_refuses_nobody(home: Home, monkeypatch: pytest.MonkeyPatch) -> None:
    with lease(ROBOT, "cobot-a", home):
        pass
    path = home.root / "locks" / "machine-cobot-a.lock"
    asking = path.open("r+b")
    assert take(asking.fileno())
    # The moment passes while the server waits.
    monkeypatch.setattr(_lease.time, "sleep", lambda _: asking.close())
    with lease(ROBOT, "cobot-a", home):
        pass


@pytest.mark.parametrize(("host", "machine"), [(ROBOT, "cobot-b"), ("localhost", "cobot-b"), ("127.0.0.9", "cobot-a")])
def test_robot_and_machine_are_held_each(home: Home, host: str, machine: str) -> None:
    with (
        held_elsewhere(home, ROBOT, "cobot-a"),
        pytest.raises(DeviceError, match="served already"),
        lease(host, machine, home),
    ):
        raise AssertionError("two servers")


def test_other_robots_are_free(home: Home) -> None:
    with held_elsewhere(home, ROBOT, "cobot-a"), lease("127.0.0.9", "cobot-b", home):
        pass


def test_refused_second_lock_frees_the_first(home: Home) -> None:
    with held_elsewhere(home, ROBOT, "cobot-a"):
        with pytest.raises(DeviceError), lease("127.0.0.9", "cobot-a", home):
            pass
        with lease("127.0.0.9", "cobot-b", home):
            pass


def test_killed_server_frees_the_robot(home: Home) -> None:
    with held_elsewhere(home, ROBOT, "cobot-a") as other:
        other.kill()
        other.wait(300)
        with lease(ROBOT, "cobot-a", home):
            pass


def test_no_place_for_the_lock_means_no_motion(home: Home) -> None:
    home.root.parent.mkdir(exist_ok=True)
    home.root.write_text("a file where the folder should be")
    with pytest.raises(StoreError, match="nothing may move"), lease(ROBOT, "cobot-a", home):
        pass


def test_names_cannot_leave_the_folder(home: Home) -> None:
    with pytest.raises(InputError), lease("../../x", "../x", home):
        pass
    with lease("../../x", "cobot-a", home):
        found = [p.relative_to(home.root) for p in home.root.rglob("*.lock")]
    assert len(found) == 2
    assert all(p.parent == Path("locks") for p in found)
