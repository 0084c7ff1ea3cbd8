"""Whatever happens to robot, link or loop: the robot's end returns to zero and the journal says why."""

from __future__ import annotations

import json
import math
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from served_robot import (
    MACHINE,
    Server,
    applied_um,
    end_what_is_left,
    events,
    noted,
    promote,
    refused,
    wait_for,
    wait_until_corrected,
    wait_until_released,
)
from virtual_robot import VirtualRobot, virtual_robot

from dtwin.config import Home
from dtwin.config import home as dtwin_home
from dtwin.errors import DeviceError, DtwinError
from dtwin.features.windows import WindowContract
from dtwin.links import layout
from dtwin.links.ur import UrLink
from dtwin.serve.builder import GraphBuilder
from dtwin.serve.interface import Input, SafetyLimits
from dtwin.serve.serve_request import ServeRequest
from dtwin.serve.session import serve
from dtwin.serve.withdrawn import stop_serving

pytestmark = pytest.mark.system

PUSH_UM = np.array([100.0, -40.0, 15.0])
CONTROLLER_STEP_UM = 20_000.0 / 500.0
FEED_MM_MIN = 3000.0
PATIENCE = 6


@pytest.fixture(autouse=True)
def _nothing_left() -> Iterator[None]:
    yield
    end_what_is_left()


@pytest.fixture
def home() -> Home:
    return dtwin_home()


@pytest.fixture(scope="module")
def robot() -> Iterator[VirtualRobot]:
    with virtual_robot(f"--feed-mm-min={FEED_MM_MIN}") as running:
        yield running


@pytest.fixture
def own_robot() -> Iterator[VirtualRobot]:
    with virtual_robot(f"--feed-mm-min={FEED_MM_MIN}") as running:
        yield running


def by_feed(home: Home) -> None:
    """A champion whose radial correction grows with the feed: 24 um at the programmed one."""
    g = GraphBuilder()
    promote(
        home,
        inputs=[Input("programmed_feed_mm_min", "mm/min", "path", 500.0, "path", 0.0, 1.2 * FEED_MM_MIN)],
        tick_graph=g.graph({"radial_error_um": 8e-3 * g.input("programmed_feed_mm_min")}),
    )


def applied_length_um(robot: VirtualRobot) -> float:
    return float(np.linalg.norm(robot.do("status")["applied_um"]))


def cut_while_pushing(robot: VirtualRobot, path: Path) -> dict[str, np.ndarray]:
    with UrLink(robot.host, realtime=False) as link:
        state = link.wait_state(5.0)
        assert state is not None
        first = int(state[layout.APPLIED_SEQUENCE]) + 1
        with pytest.raises(DeviceError) as caught:  # noqa: PT012
            for sequence in range(first, first + 5000):
                held = state is not None and state[layout.APPLIED_SEQUENCE]
                link.send(PUSH_UM if held else np.zeros(3), sequence)
                state = link.wait_state(5.0)
                if sequence > first + 100 and state is not None and state[layout.APPLIED] > 99.0:
                    robot.do("drop")
        assert caught.value.code.startswith("ur.")
    wait_until_released(robot)
    robot.do("offset_log", path=str(path))
    with np.load(path) as log:
        return dict(log)


def test_a_cut_link_is_zero_at_the_controller_within_twenty_milliseconds(tmp_path: Path) -> None:
    with virtual_robot(f"--feed-mm-min={FEED_MM_MIN}", watchdog_s=None) as robot:
        for attempt in range(5):
            log = cut_while_pushing(robot, tmp_path / f"log-{attempt}.npz")
            at = int(np.flatnonzero(log["tick"] == log["cut_tick"])[0])
            if log["commanded_um"][at, 0] > 99.0:
                break
        else:
            pytest.fail("the test computer was too busy to hold a correction until the cut")
    length = np.abs(log["commanded_um"]).max(axis=1)
    zero_after = int(np.flatnonzero(length[at:] == 0.0)[0])
    assert zero_after * float(log["period_s"]) <= 0.020
    assert not length[at + zero_after :].any()
    steps = np.abs(np.diff(log["commanded_um"], axis=0))
    assert steps.max() <= CONTROLLER_STEP_UM * (1 + 1e-9)


def test_one_client_may_write_and_any_may_listen(robot: VirtualRobot) -> None:
    with UrLink(robot.host, realtime=False) as first:
        with pytest.raises(DeviceError, match="owns the correction's input registers") as refused:
            UrLink(robot.host, realtime=False)
        assert refused.value.code == "ur.registers_owned"
        with UrLink(robot.host, realtime=False, writes=False) as listening:
            assert listening.wait_state(5.0) is not None
        assert first.wait_state(5.0) is not None
    # The registers are free again when their owner has gone.
    with UrLink(robot.host, realtime=False) as again:
        assert again.wait_state(5.0) is not None


def test_somebody_who_writes_by_the_side_ends_the_serving(robot: VirtualRobot, home: Home) -> None:
    promote(home)
    server = Server("--json", f"--host={robot.host}")
    wait_until_corrected(robot)
    robot.do("intrude", sequence=2_000_000)
    code, out, err = server.end()
    status = json.loads(out)
    assert (code, status["ended"]) == (4, "serve.other_writer")
    assert "another client writes" in err
    wait_until_released(robot)
    assert noted(home, "released")[-1]["why"] == "serve.other_writer"


def test_the_slider_pauses_and_stops_are_followed(own_robot: VirtualRobot, home: Home) -> None:
    robot = own_robot
    by_feed(home)
    server = Server("--json", f"--host={robot.host}", "--patience=30")

    def at(length_um: float) -> None:
        near = lambda: abs(applied_length_um(robot) - length_um) < 1.5  # noqa: E731
        wait_for(near, f"never {length_um} µm: {applied_length_um(robot)}")

    at(24.0)
    robot.do("speed", factor=0.5)
    at(12.0)
    robot.do("speed", factor=0.0)
    at(0.0)
    robot.do("speed", factor=1.0)
    at(24.0)
    for stop in ("pause", "pause", "pause", "pause", "protective_stop"):
        robot.do(stop)
        at(0.0)
        robot.do("resume")
        at(24.0)
    robot.do("emergency_stop")
    code, out, _ = server.end()
    status = json.loads(out)
    assert (code, status["ended"], status["released"]) == (4, "safety_stop", True)
    assert status["fault"]["got"] == "emergency stop"
    at(0.0)
    seen = [line["now"] for line in noted(home, "program")]
    assert seen[:2] == ["paused", "running"]
    assert seen[-3:] == ["protective_stop", "running", "emergency_stop"]
    assert "latched" not in status["reasons"]


def test_a_restarted_controller_is_found_again_and_corrected_from_zero(home: Home, tmp_path: Path) -> None:
    promote(home)
    with virtual_robot(f"--feed-mm-min={FEED_MM_MIN}") as robot:
        server = Server("--json", f"--host={robot.host}", "--patience=60")
        wait_until_corrected(robot)
        robot.process.kill()
        robot.process.wait()
    time.sleep(0.5)
    with virtual_robot(f"--feed-mm-min={FEED_MM_MIN}", host=robot.host) as again:
        wait_until_corrected(again)
        again.do("drop")
        wait_until_released(again)
        wait_until_corrected(again)
        again.do("clock_jump", seconds=-5.0)
        wait_for(lambda: bool(noted(home, "clock_jump")), "the jump was not noted")
        wait_until_corrected(again)
        before = len(noted(home, "clock_jump"))
        again.do("clock_jump", seconds=3600.0)
        wait_for(lambda: len(noted(home, "clock_jump")) > before, "the jump was not noted")
        wait_until_corrected(again)
        server.interrupt()
        code, out, _ = server.end()
        again.do("offset_log", path=str(tmp_path / "log.npz"))
    status = json.loads(out)
    assert (code, status["ended"], status["reconnects"]) == (0, "stopped", 2)
    # At 500 Hz an hour that nobody missed would be 1.8 million.
    assert status["timing"]["missed_states"] < 900_000
    assert [line["event"] for line in events(home) if "link" in line["event"]] == ["link_lost"] * 2
    assert len(noted(home, "reconnected")) == 2
    with np.load(tmp_path / "log.npz") as log:
        received = log["received_um"][np.diff(log["sequence"], prepend=0.0) != 0]
        # The bundle allows 2000 um/s, and counts a late tick as at most 20 ms.
        assert np.linalg.norm(np.diff(received, axis=0), axis=1).max() <= 2000.0 * 0.02 + 1e-6
        assert np.linalg.norm(received[0]) <= 2000.0 * 0.02 + 1e-6
        assert np.abs(np.diff(log["commanded_um"], axis=0)).max() <= CONTROLLER_STEP_UM + 1e-9


def test_a_frozen_host_leaves_a_half_open_link_and_the_robot_lets_go(robot: VirtualRobot) -> None:
    # A busy computer may hold the controller up for longer than a third of a second.
    with UrLink(robot.host, realtime=False, lost_after_s=1.0) as link:
        state = link.wait_state(5.0)
        assert state is not None
        first = int(state[layout.APPLIED_SEQUENCE]) + 1
        for sequence in range(first, first + 60):
            link.send(PUSH_UM if state[layout.APPLIED_SEQUENCE] else np.zeros(3), sequence)
            state = link.wait_state(5.0)
            assert state is not None
        os.kill(link.process_id, signal.SIGSTOP)
        with pytest.raises(DeviceError, match="hangs") as caught:  # noqa: PT012
            while True:
                link.wait_state(0.1)
        assert caught.value.code == "ur.driver_stuck"
        wait_until_released(robot)


def test_a_loop_that_is_killed_at_any_moment_is_released_and_noted(robot: VirtualRobot, home: Home) -> None:
    promote(home)
    rng = np.random.default_rng(5)
    for count, delay_s in enumerate(rng.uniform(0.0, 0.3, 3), start=1):
        server = Server(f"--host={robot.host}")
        server.wait_for("serving the virtual controller")
        time.sleep(float(delay_s))
        server.process.kill()
        server.end()
        wait_until_released(robot)
        wait_for(lambda count=count: len(noted(home, "killed")) == count, "no word of the death")
    assert "died without a word" in noted(home, "killed")[-1]["why"]
    assert applied_um(robot) < 0.5


def test_a_full_disk_costs_lines_and_never_the_correction(robot: VirtualRobot, home: Home) -> None:
    promote(home)
    home.logs.mkdir(parents=True)
    for name in ("serve-cobot-a.jsonl", "serve-cobot-a.events.jsonl"):
        (home.logs / name).symlink_to("/dev/full")
    server = Server("--json", f"--host={robot.host}")
    wait_until_corrected(robot)
    server.interrupt()
    code, out, err = server.end()
    status = json.loads(out)
    assert (code, status["ended"], status["released"]) == (0, "stopped", True)
    assert status["log"].startswith("not written: No space left")
    assert "are not complete" in err
    wait_until_released(robot)


def test_a_model_that_is_withdrawn_while_it_is_served_lets_go(robot: VirtualRobot, home: Home) -> None:
    promote(home)
    server = Server("--json", f"--host={robot.host}")
    wait_until_corrected(robot)
    stop_serving(MACHINE, home, 3, "the error is larger with the correction: all 30.0 -> 40.0 µm")
    code, out, _ = server.end()
    status = json.loads(out)
    assert (code, status["ended"], status["released"]) == (3, "withdrawn", True)
    assert status["fault"]["got"].startswith("the error is larger")
    wait_until_released(robot)
    code, answer = refused(f"--host={robot.host}")
    assert (code, answer["error"]["code"]) == (3, "serve.not_passed")


class SpoiledWindows:
    """One window every 10 ms, of a sensor that goes through its faults."""

    over = False

    def __init__(self, contract: WindowContract) -> None:
        self.contract = contract
        self._rng = np.random.default_rng(0)
        self._began_s = self._delivered_s = math.nan

    def newest_window(self) -> tuple[np.ndarray | None, float]:
        now_s = time.monotonic()
        if math.isnan(self._began_s):
            self._began_s = self._delivered_s = now_s
        phase = min(int((now_s - self._began_s) / 0.4), 6)
        age_s = now_s - self._delivered_s
        if phase == 5 or age_s < 0.01:
            return None, age_s
        self._delivered_s = now_s
        block = 0.1 * self._rng.standard_normal((1, self.contract.n_samples))
        if phase == 1:
            block[:] = 0.25
        elif phase == 3:
            np.clip(block, -0.05, 0.05, out=block)
        return block, 0.0

    def fault(self) -> DtwinError | None:
        return None

    def __enter__(self) -> SpoiledWindows:
        return self

    def __exit__(self, *_: object) -> None:
        pass


def test_a_stuck_a_saturated_and_a_silent_sensor_lead_to_zero_by_name(robot: VirtualRobot, home: Home) -> None:
    g = GraphBuilder()
    promote(
        home,
        inputs=[Input("wrist_x_rms_g", "g", "sensor", 110.0, "feature", 0.0, 2.0)],
        window=WindowContract(1652.0, 150, 15, ("wrist_x_g",), ("rms",)),
        tick_graph=g.graph({"radial_error_um": 200.0 * g.input("wrist_x_rms_g")}),
        safety=SafetyLimits(clamp_um=40.0, slew_um_s=2000.0, stale_s=0.3, window_stale_s=0.1, trips_to_latch=99),
    )
    request = ServeRequest(host=robot.host, duration_s=2.8, priority=0)
    wanted = (("not_finite", "wrist_x_g: stuck"), ("not_finite", "wrist_x_g: saturated"), ("stale_window", ""))
    # A starved computer misses faults of 0.4 s: then once more.
    for _ in range(PATIENCE):
        status = serve(request, home, lambda _: None, SpoiledWindows).status
        assert (status.ended, status.released) == ("duration", True)
        told = [(line["why"], line.get("sensors", "")) for line in noted(home, "guard")]
        # It may add a stale state of its own before it corrects again.
        if all(one in told and ("correcting", "") in told[told.index(one) + 1 :] for one in wanted):
            break
    else:
        raise AssertionError(told)
    wait_until_released(robot)
