import os
import signal
import subprocess
import sys
from pathlib import Path

from dtwin.locks import locked, take


def test_a_lock_is_held_alone_or_shared(tmp_path: Path) -> None:
    path = tmp_path / "some.lock"
    path.touch()
    with path.open() as one, path.open() as other, path.open() as third:
        assert take(one, shared=True)
        assert take(other, shared=True)
        assert not take(third)
        one.close()
        assert not take(third)
        other.close()
        assert take(third)
        with locked(path) as mine:
            assert not mine


def test_a_killed_process_lets_go(tmp_path: Path) -> None:
    path = tmp_path / "folder" / "some.lock"
    code = f"from pathlib import Path\nfrom dtwin.locks import locked\nwith locked(Path({str(path)!r})):\n print(flush=True)\n input()"
    holder = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert holder.stdout is not None
    assert holder.stdout.readline() == b"\n"
    with locked(path) as mine:
        assert not mine
    os.kill(holder.pid, signal.SIGKILL)
    holder.communicate()
    with locked(path) as mine:
        assert mine
