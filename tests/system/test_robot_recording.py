"""Recording the controller over real RTDE, with losses seen by its own clock."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from virtual_robot import VirtualRobot, free_address, virtual_robot

from dtwin.acquire._recording import Recorder
from dtwin.acquire._recovery import seal
from dtwin.acquire._robot import RobotRecorder
from dtwin.acquire.instrument import record
from dtwin.acquire.signal_files import read_signals
from dtwin.errors import DeviceError

pytestmark = pytest.mark.system


@pytest.fixture
def robot() -> Iterator[VirtualRobot]:
    with virtual_robot("--feed-mm-min=3000") as running:
        yield running


def recorder(path: Path, robot: RobotRecorder) -> Recorder:
    described = robot.describe()
    return Recorder(path, described.group, described.rate_hz, described.columns, durable=False)


def test_the_recording_is_the_controllers_motion_by_its_clock(robot: VirtualRobot, tmp_path: Path) -> None:
    stream = tmp_path / "r1.controller.arrows"
    with RobotRecorder(robot.host) as recording, recorder(stream, recording) as writing:
        recording.start()
        record(recording, writing, lambda n: n < 250)
    seal(stream, tmp_path / "r1.controller.parquet")
    (group,) = read_signals(tmp_path / "r1.controller.parquet")
    assert (group.name, group.rate_hz) == ("controller", 125.0)
    stamps = group.columns["timestamp_s"]
    there = np.flatnonzero(~np.isnan(stamps))
    # A busy host skips states; the gaps are in it as such.
    assert len(there) > 50
    # Every sample has its place on the clock, lost ones or not.
    np.testing.assert_allclose(stamps[there], stamps[there[0]] + (there - there[0]) / 125.0, atol=2.5e-3)
    path = np.array([group.columns[f"target_tcp_{axis}_mm"] for axis in "xyz"])
    speed = np.linalg.norm(np.diff(path, axis=1), axis=0) * 125.0
    assert 20.0 < np.nanmax(speed) < 80.0


def test_states_that_the_controller_skips_are_gaps(robot: VirtualRobot, tmp_path: Path) -> None:
    stream = tmp_path / "r1.controller.arrows"
    with RobotRecorder(robot.host) as recording, recorder(stream, recording) as writing:
        recording.start()
        record(recording, writing, lambda n: n < 50)
        robot.do("stall", seconds=0.4)
        record(recording, writing, lambda n: n < 250)
    sealed = seal(stream, tmp_path / "r1.controller.parquet")
    gaps = json.loads(pq.read_schema(sealed.path).metadata[b"dtwin.signals"])["gaps"]
    assert max(lost for _, lost, _ in gaps) >= 25
    stamps = read_signals(sealed.path)[0].columns["timestamp_s"]
    there = np.flatnonzero(~np.isnan(stamps))
    np.testing.assert_allclose(stamps[there], stamps[there[0]] + (there - there[0]) / 125.0, atol=2.5e-3)


def test_a_lost_link_ends_the_reading_and_keeps_what_was_read(robot: VirtualRobot, tmp_path: Path) -> None:
    stream = tmp_path / "r1.controller.arrows"

    def until_it_breaks() -> None:
        with RobotRecorder(robot.host) as recording, recorder(stream, recording) as writing:
            recording.start()
            record(recording, writing, lambda n: n < 50)
            robot.do("drop")
            record(recording, writing, lambda n: True)

    with pytest.raises(DeviceError):
        until_it_breaks()
    sealed = seal(stream, tmp_path / "r1.controller.parquet")
    assert not sealed.complete
    assert sealed.n_samples >= 50


def test_an_absent_robot_is_named() -> None:
    host = free_address()
    with pytest.raises(DeviceError) as caught:
        RobotRecorder(host, timeout_s=1.0).open()
    assert caught.value.code == "ur.absent"
    assert host in caught.value.render()
