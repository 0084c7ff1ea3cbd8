"""The supervised link, with the real ur-rtde client, against the virtual robot."""

from __future__ import annotations

import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from virtual_robot import VirtualRobot, free_address, virtual_robot

from dtwin.errors import EXIT_DEVICE, DeviceError, InputError
from dtwin.links import layout
from dtwin.links._ur_memory import SharedMemory
from dtwin.links.ur import UrLink
from dtwin.links.ur_registers import safety_ok
from dtwin.links.ur_worker import _VARIABLES, _Fault, _Worker

pytestmark = pytest.mark.system

PUSH_UM = np.array([120.0, -40.0, 15.0])


@pytest.fixture(scope="module")
def robot() -> Iterator[VirtualRobot]:
    with virtual_robot("--feed-mm-min=3000") as running:
        yield running


@pytest.fixture
def own_robot() -> Iterator[VirtualRobot]:
    with virtual_robot("--feed-mm-min=3000") as running:
        yield running


@pytest.fixture
def link(robot: VirtualRobot) -> Iterator[UrLink]:
    with UrLink(robot.host, realtime=False) as connected:
        yield connected


def next_state(link: UrLink) -> np.ndarray:
    state = link.wait_state(5.0)
    assert state is not None
    return state


def until(link: UrLink, holds: Callable[[np.ndarray], bool], tries: int = 5000) -> np.ndarray:
    for _ in range(tries):
        state = next_state(link)
        if holds(state):
            return state
    raise AssertionError("never came true")


def pushed(state: np.ndarray) -> np.ndarray:
    """What was dropped comes back only from zero: on a busy host the watchdog may come in between."""
    return PUSH_UM if state[layout.APPLIED_SEQUENCE] else np.zeros(3)


def push(link: UrLink, ticks: int, first_sequence: int = 1) -> np.ndarray:
    state = next_state(link)
    for sequence in range(first_sequence, first_sequence + ticks):
        link.send(pushed(state), sequence)
        state = next_state(link)
    return state.copy()


def push_until_applied(link: UrLink, first_sequence: int, tries: int = 5000) -> None:
    """Push until a state says that it acts."""
    state = next_state(link)
    for sequence in range(first_sequence, first_sequence + tries):
        link.send(pushed(state), sequence)
        state = next_state(link)
        if np.abs(state[layout.APPLIED : layout.APPLIED + 3]).max() > 50:
            return
    raise AssertionError("never applied")


def applied_um(robot: VirtualRobot) -> float:
    return float(np.abs(robot.do("status")["applied_um"]).max())


def wait_for_release(robot: VirtualRobot) -> None:
    while applied_um(robot) > 0.5:
        time.sleep(0.01)


def fault_of(link: UrLink) -> DeviceError:
    def wait_on() -> None:
        while True:
            link.wait_state(10.0)

    with pytest.raises(DeviceError) as caught:
        wait_on()
    assert not link.alive
    with pytest.raises(DeviceError):
        link.send(PUSH_UM, 7)
    assert caught.value.exit_code == EXIT_DEVICE
    assert caught.value.hint
    return caught.value


def test_states_are_complete_and_consistent(link: UrLink) -> None:
    stamps = []
    tcp = slice(layout.TARGET_TCP, layout.TARGET_TCP + 3)
    for _ in range(200):
        state = next_state(link)
        stamps.append(state[layout.TIMESTAMP])
        centre = state[layout.CENTRE : layout.CENTRE + 3]
        assert 99.99 < np.linalg.norm(state[tcp] - centre) < 101.51
    assert link.received_s <= time.monotonic()
    ticks = np.diff(stamps) * 500
    assert ticks.min() > 0.99
    np.testing.assert_allclose(ticks, np.round(ticks), atol=1e-3)
    assert state[layout.RADIUS] == 100.0
    assert state[layout.FEED] == 3000.0
    assert state[layout.DIRECTION_SIGN] == 1.0
    assert state[layout.RUNTIME_RUNNING] == 1.0
    assert state[layout.SAFETY_OK] == 1.0
    assert state[layout.SPEED_SCALING] == 1.0


def test_correction_is_applied_and_its_sequence_echoed(robot: VirtualRobot, link: UrLink, tmp_path: Path) -> None:
    for first in range(1, 2001, 100):
        # On a busy host the watchdog may come in between; then push again.
        state = push(link, 100, first_sequence=first)
        at, echoed = state[layout.APPLIED : layout.APPLIED + 3], state[layout.APPLIED_SEQUENCE]
        if np.allclose(at, PUSH_UM, rtol=0.02) and echoed > first + 49:
            break
    np.testing.assert_allclose(state[layout.APPLIED : layout.APPLIED + 3], PUSH_UM, rtol=0.02)
    assert first + 49 < state[layout.APPLIED_SEQUENCE] <= first + 99
    robot.do("latency_log", path=str(tmp_path / "log.npz"))
    with np.load(tmp_path / "log.npz") as log:
        assert np.all(np.diff(log["sequence"]) > 0)
        assert len(log["sequence"]) > 50
        assert np.all(log["arrived_s"] < log["latched_s"] + 1.0)


def test_close_leads_the_offset_back_to_zero(robot: VirtualRobot, link: UrLink) -> None:
    push(link, 50)
    link.close()
    link.close()
    wait_for_release(robot)
    assert not link.alive
    with pytest.raises(DeviceError):
        link.wait_state(0.1)


def test_absent_robot_is_reported_plainly() -> None:
    address = free_address()
    with pytest.raises(DeviceError) as caught:
        UrLink(address)
    assert caught.value.code == "ur.absent"
    assert address in caught.value.render()
    assert "30004" in (caught.value.hint or "")


def test_something_that_never_answers_is_reported_in_time() -> None:
    address = free_address()
    with socket.create_server((address, 30004)):
        with pytest.raises(DeviceError) as caught:
            UrLink(address, connect_timeout_s=1.5)
        assert caught.value.code == "ur.absent"


def _frame_of_types(**other: str) -> bytes:
    payload = b"\x01" + ",".join((_VARIABLES | other).values()).encode()
    return struct.pack(">HB", 3 + len(payload), 79) + payload


@pytest.mark.parametrize(
    ("answers", "code", "said"),
    [
        ([b"\x00\x06Mold\x00\x04V\x00"], "ur.protocol", "version 2 of RTDE"),
        ([b"\x00\x04V\x01", b"\x00\x1aO\x01DOUBLE,NOT_FOUND,INT32"], "ur.variables", "send target_q, actual_q,"),
        ([b"\x00\x04V\x01", _frame_of_types(timestamp="INT32")], "ur.variables", "timestamp as INT32"),
        ([b"HTTP/1.1 400 Bad Request\r\n"], "ur.protocol", "no RTDE"),
        ([b""], "ur.absent", "closed the connection"),
    ],
)
def test_a_controller_that_is_too_old_is_told(answers: list[bytes], code: str, said: str) -> None:
    address = free_address()

    def answer(listener: socket.socket) -> None:
        client, _ = listener.accept()
        with client:
            for one in answers:
                client.recv(4096)
                client.sendall(one)
            if answers[-1]:
                # It does not hang up: what it said is enough to know what it is.
                client.recv(4096)

    with socket.create_server((address, 30004)) as listener:
        server = threading.Thread(target=answer, args=(listener,))
        server.start()
        with pytest.raises(DeviceError, match=said) as caught:
            UrLink(address, realtime=False)
        server.join()
    assert caught.value.code == code


def test_a_controller_that_never_sends_a_state_is_silent(monkeypatch: pytest.MonkeyPatch) -> None:
    """ur_rtde tells a time of 0 and no joints then; the driver died of the joints."""
    ends, awake = os.pipe(), os.eventfd(0)
    worker = object.__new__(_Worker)
    nothing = SimpleNamespace(getTimestamp=lambda: 0.0, getTargetQ=list, isConnected=lambda: True)
    vars(worker).update(_frequency_hz=500.0, _lost_after_s=0.05, _correction_ready=awake, _receive=nothing)
    with os.fdopen(ends[0]) as life_line:
        monkeypatch.setattr("sys.stdin", life_line)
        with pytest.raises(_Fault, match="sent nothing"):
            worker.run()
    os.close(ends[1])
    os.close(awake)


@pytest.mark.parametrize("failure", ["drop", "half_frame"])
def test_broken_connection_is_a_fault(robot: VirtualRobot, link: UrLink, failure: str) -> None:
    push(link, 50)
    robot.do(failure)
    assert fault_of(link).code in {"ur.link_lost", "ur.driver_died", "ur.silent"}
    wait_for_release(robot)


def test_end_of_the_robot_is_a_fault(own_robot: VirtualRobot) -> None:
    with UrLink(own_robot.host, realtime=False) as link:
        push(link, 50)
        own_robot.process.kill()
        own_robot.process.wait()
        assert fault_of(link).code in {"ur.link_lost", "ur.driver_died", "ur.silent"}


def test_short_stall_is_survived_and_the_watchdog_released(robot: VirtualRobot, link: UrLink) -> None:
    state = push(link, 50)
    before_s = state[layout.TIMESTAMP]
    robot.do("stall", seconds=0.8)
    until(link, lambda s: s[layout.TIMESTAMP] > before_s + 0.8)
    state = next_state(link)
    np.testing.assert_allclose(state[layout.APPLIED : layout.APPLIED + 3], 0.0, atol=0.5)
    push_until_applied(link, first_sequence=1000)


def test_silence_is_a_fault_at_last(robot: VirtualRobot) -> None:
    with UrLink(robot.host, lost_after_s=0.5, realtime=False) as link:
        next_state(link)
        robot.do("stall", seconds=1.5)
        assert fault_of(link).code == "ur.silent"
    time.sleep(1.0)


def test_death_of_the_driver_is_a_fault_and_the_robot_lets_go(robot: VirtualRobot, link: UrLink) -> None:
    push(link, 50)
    os.kill(link.process_id, signal.SIGKILL)
    fault = fault_of(link)
    assert fault.code == "ur.driver_died"
    assert "SIGKILL" in fault.message
    wait_for_release(robot)


def test_driver_ends_with_its_host(robot: VirtualRobot) -> None:
    code = f"""
import sys, time
import numpy as np
from dtwin.links.ur import UrLink
link = UrLink({robot.host!r}, realtime=False)
print(link.process_id, flush=True)
for sequence in range(1, 100000):
    state = link.wait_state(1.0)
    held = state is not None and state[{layout.APPLIED_SEQUENCE}]
    link.send(np.array([100.0 if held else 0.0, 0.0, 0.0]), sequence)
"""
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as host:
        assert host.stdout is not None
        driver = int(host.stdout.readline())
        while applied_um(robot) < 50:
            time.sleep(0.01)
        host.kill()
    wait_for_release(robot)
    while Path(f"/proc/{driver}/stat").exists():
        if Path(f"/proc/{driver}/stat").read_text().rpartition(")")[2].split()[0] == "Z":
            break
        time.sleep(0.01)


def test_slow_controller_speed_slider_and_protective_stop_are_seen(own_robot: VirtualRobot) -> None:
    with UrLink(own_robot.host, realtime=False) as link:
        check_slow_scaled_and_stopped(own_robot, link)


def check_slow_scaled_and_stopped(robot: VirtualRobot, link: UrLink) -> None:
    robot.do("slow", factor=4)
    next_state(link)
    for _ in range(20):
        next_state(link)
    first = next_state(link)[layout.TIMESTAMP]
    ticks = (next_state(link)[layout.TIMESTAMP] - first) * 500
    assert round(ticks) % 4 == 0
    robot.do("slow", factor=1)
    robot.do("speed", factor=0.5)
    until(link, lambda s: s[layout.SPEED_SCALING] == 0.5)
    robot.do("protective_stop")
    state = until(link, lambda s: s[layout.SAFETY_OK] == 0.0)
    assert state[layout.RUNTIME_RUNNING] == 0.0


def test_safety_bits_of_no_mode_are_not_safe() -> None:
    assert [safety_ok(bits) for bits in (0b1, 0b10, 0)] == [layout.SAFE, layout.SAFE, layout.PROTECTIVE_STOP]
    assert [safety_ok(1 | 1 << bit) for bit in range(2, 11)].count(layout.SAFE) == 0


def test_bad_corrections_never_leave_the_host(link: UrLink) -> None:
    for offset, sequence in (([np.nan, 0, 0], 1), ([0, 0, 0], 0), ([0, 0, 0], 2**31)):
        with pytest.raises(InputError):
            link.send(np.array(offset, dtype=float), sequence)
    with pytest.raises(InputError):
        UrLink("127.0.0.1", frequency_hz=1000)


def test_shared_memory_passes_whole_records() -> None:
    descriptor = SharedMemory.create()
    one, two = SharedMemory(descriptor), SharedMemory(descriptor)
    into = np.zeros(layout.N + 1)
    assert not two.read_state(into)
    one.write_state(np.arange(layout.N, dtype=float), 5.0)
    assert two.read_state(into) == 1
    np.testing.assert_array_equal(into, [*range(layout.N), 5.0])
    one.write_state(layout.empty_state(), 6.0)
    # The number is that of what was read: a state that comes in between is not read twice.
    assert two.read_state(into) == 2
    one.write_correction(3, PUSH_UM)
    registers = np.zeros(4)
    assert two.read_correction(registers)
    np.testing.assert_array_equal(registers, [3, *PUSH_UM])
    os.close(descriptor)
