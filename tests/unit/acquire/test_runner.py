from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from dtwin.acquire._recording import Recorder
from dtwin.acquire.campaign_folder import open_campaign
from dtwin.acquire.runner import _MANIFEST, Bench, run_campaign
from dtwin.acquire.signal_files import read_signals
from dtwin.acquire.virtual import VirtualCobotBench
from dtwin.errors import Interrupted, StoreError
from dtwin.plan import Plan, PlannedTest, training_plan
from dtwin.schema import Direction, Run


def small_plan(name: str = "small", feeds: tuple[float, ...] = (4000.0, 6000.0)) -> Plan:
    return training_plan(radii_mm=(100.0,), feeds_mm_min=feeds, planes=("YZ",), repeats=1, name=name)


def test_a_campaign_is_complete_and_repeatable(tmp_path: Path) -> None:
    done = run_campaign(small_plan(), VirtualCobotBench(), tmp_path / "c")
    assert (done.measured, done.kept) == (2, 0)
    folder = open_campaign(tmp_path / "c")
    runs = [run for found, _ in folder for run in found]
    assert sorted(run.meta.run_id for run in runs) == ["t001-ccw", "t001-cw", "t002-ccw", "t002-cw"]
    for run in runs:
        assert {group.name for group in run.signals} == {"accelerometers", "controller"}
    again = run_campaign(small_plan(), VirtualCobotBench(), tmp_path / "c")
    assert (again.measured, again.kept) == (0, 2)
    run_campaign(small_plan(), VirtualCobotBench(), tmp_path / "d")
    for file in ("t001.b5r", "t002-cw.accelerometers.parquet"):
        assert (tmp_path / "c" / file).read_bytes() == (tmp_path / "d" / file).read_bytes()


def test_another_plan_does_not_overwrite(tmp_path: Path) -> None:
    run_campaign(small_plan(), VirtualCobotBench(), tmp_path)
    with pytest.raises(StoreError, match="another plan"):
        run_campaign(small_plan(feeds=(2000.0,)), VirtualCobotBench(), tmp_path)


def test_damaged_files_are_measured_again(tmp_path: Path) -> None:
    run_campaign(small_plan(), VirtualCobotBench(), tmp_path)
    (tmp_path / "t001.b5r").write_text("damaged")
    with (tmp_path / _MANIFEST).open("a") as handle:
        handle.write('{"test": "t0')
    again = run_campaign(small_plan(), VirtualCobotBench(), tmp_path)
    assert (again.measured, again.kept) == (1, 1)


class StoppedBench(VirtualCobotBench):
    """A user presses Ctrl-C during the second test."""

    def __init__(self) -> None:
        super().__init__()
        self.calls = 0
        self.closed = 0

    def measure(self, test: PlannedTest, direction: Direction) -> Run:
        self.calls += 1
        if self.calls == 3:
            raise KeyboardInterrupt
        return super().measure(test, direction)

    def close(self) -> None:
        self.closed += 1


def test_ctrl_c_keeps_what_is_done_and_says_how_to_go_on(tmp_path: Path) -> None:
    bench = StoppedBench()
    assert isinstance(bench, Bench)
    with pytest.raises(Interrupted) as caught:
        run_campaign(small_plan(), bench, tmp_path)
    assert caught.value.exit_code == 130
    assert bench.closed == 1
    assert len(open_campaign(tmp_path).entries) == 1
    assert run_campaign(small_plan(), VirtualCobotBench(), tmp_path).kept == 1


_CHILD = """
import sys
from pathlib import Path
from dtwin.acquire.runner import run_campaign
from dtwin.acquire.signal_files import read_signals
from dtwin.acquire.virtual import VirtualCobotBench
from dtwin.plan import training_plan
plan = training_plan(radii_mm=(100.0,), feeds_mm_min=(4000.0, 6000.0), planes=("YZ",), repeats=4)
run_campaign(plan, VirtualCobotBench(), Path(sys.argv[1]), lambda d, n, w: print(w, flush=True))
"""
_PLAN = training_plan(radii_mm=(100.0,), feeds_mm_min=(4000.0, 6000.0), planes=("YZ",), repeats=4)


def test_a_killed_campaign_continues_and_ends_the_same(tmp_path: Path) -> None:
    child = subprocess.Popen([sys.executable, "-c", _CHILD, str(tmp_path / "a")], stdout=subprocess.PIPE)
    assert child.stdout is not None
    for _ in range(3):
        child.stdout.readline()
    time.sleep(0.03)
    child.send_signal(signal.SIGKILL)
    child.wait()
    child.stdout.close()
    kept = len((tmp_path / "a" / _MANIFEST).read_text().splitlines())
    assert 3 <= kept < 8
    for target in ("a", "b"):
        run_campaign(_PLAN, VirtualCobotBench(), tmp_path / target)
    for name in sorted(p.name for p in (tmp_path / "b").glob("t*")):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    plan = json.loads((tmp_path / "a" / "plan.json").read_text())
    assert len(plan["tests"]) == 8
    assert np.isfinite(
        open_campaign(tmp_path / "a").read(open_campaign(tmp_path / "a").entries[0])[0][0].samples["deviation_um"]
    ).all()


def test_a_resumed_campaign_seals_what_a_dead_recorder_left(tmp_path: Path) -> None:
    folder = tmp_path / "c"
    recorder = Recorder(folder / "t001.extra.arrows", "extra", 100.0, {"x_g": np.float32})
    recorder.append({"x_g": np.ones(50, np.float32)})
    recorder.abandon()
    run_campaign(small_plan(), VirtualCobotBench(), folder)
    (group,) = read_signals(folder / "t001.extra.parquet")
    assert group.n_samples == 50
    assert not list(folder.glob("*.arrows"))
