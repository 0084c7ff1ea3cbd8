"""The virtual robot speaks RTDE to a raw socket and to the real client library."""

from __future__ import annotations

import json
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator

import numpy as np
import pytest
from virtual_robot import RTDE_PORT, VirtualRobot, virtual_robot

pytestmark = pytest.mark.system


@pytest.fixture(scope="module")
def robot() -> Iterator[VirtualRobot]:
    with virtual_robot("--plane=ZX", "--feed-mm-min=20000", "--radius-mm=100") as running:
        yield running


class RawClient:
    def __init__(self, host: str) -> None:
        self.socket = socket.create_connection((host, RTDE_PORT), timeout=5)

    def send(self, kind: int, payload: bytes) -> None:
        self.socket.sendall(struct.pack(">HB", len(payload) + 3, kind) + payload)

    def exactly(self, n: int) -> bytes:
        data = b""
        while len(data) < n:
            part = self.socket.recv(n - len(data))
            if not part:
                raise ConnectionError("closed")
            data += part
        return data

    def receive(self) -> tuple[int, bytes]:
        size, kind = struct.unpack(">HB", self.exactly(3))
        return kind, self.exactly(size - 3)

    def ask(self, kind: int, payload: bytes = b"") -> bytes:
        self.send(kind, payload)
        answered, reply = self.receive()
        assert answered == kind
        return reply


def test_negotiates_version_two_only(robot: VirtualRobot) -> None:
    client = RawClient(robot.host)
    assert client.ask(86, b"\x00\x02") == b"\x01"
    assert client.ask(86, b"\x00\x01") == b"\x00"
    assert len(client.ask(118)) == 16
    client.socket.close()


def test_streams_what_was_asked_for_at_the_rate_that_was_asked_for(robot: VirtualRobot) -> None:
    client = RawClient(robot.host)
    reply = client.ask(79, struct.pack(">d", 125.0) + b"timestamp,actual_q,runtime_state")
    assert reply == b"\x01DOUBLE,VECTOR6D,UINT32"
    assert client.ask(83) == b"\x01"
    stamps = []
    for _ in range(20):
        kind, data = client.receive()
        assert kind == 85
        number, stamp, *_, runtime = struct.unpack(">Bd6dI", data)
        assert (number, runtime) == (1, 2)
        stamps.append(stamp)
    np.testing.assert_allclose(np.diff(stamps), 1 / 125, atol=1e-9)
    client.socket.close()


def test_unknown_variables_are_named(robot: VirtualRobot) -> None:
    client = RawClient(robot.host)
    reply = client.ask(79, struct.pack(">d", 500.0) + b"timestamp,colour_of_the_robot")
    assert reply == b"\x00DOUBLE,NOT_FOUND"
    assert client.ask(73, b"input_double_register_18,taste") == b"\x00DOUBLE,NOT_FOUND"
    client.socket.close()


@pytest.mark.parametrize(
    "nonsense",
    [
        b"\x00\x00\x55",  # shorter than its own header
        b"\x00\x05\x55\x07\x07",  # data for a recipe that was never made
        b"\x00\x03\xc8",  # unknown type
        b"\x00\x03\x4f",  # output recipe without a frequency
        struct.pack(">HBd", 11, 79, float("nan")),
        # A recipe whose data are longer than a frame.
        struct.pack(">HBd", 12_611, 79, 500.0) + b"target_q," * 1400,
        b"GET / HTTP/1.1\r\n\r\n" + b"x" * 30000,
    ],
)
def test_nonsense_costs_only_its_own_connection(robot: VirtualRobot, nonsense: bytes) -> None:
    good, bad = RawClient(robot.host), RawClient(robot.host)
    bad.socket.sendall(nonsense)
    with pytest.raises(ConnectionError):
        bad.receive()
    assert good.ask(86, b"\x00\x02") == b"\x01"
    good.socket.close()
    bad.socket.close()


def test_client_that_goes_while_it_is_published_to_costs_only_itself(robot: VirtualRobot) -> None:
    client = RawClient(robot.host)
    client.ask(79, struct.pack(">d", 500.0) + b"timestamp")
    client.ask(83)
    # Unread data make close() reset the connection; the stall hides that until the next state.
    robot.do("stall", seconds=0.5)
    client.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    client.socket.close()
    while robot.do("status")["clients"]:
        time.sleep(0.02)
    assert RawClient(robot.host).ask(86, b"\x00\x02") == b"\x01"


def test_real_client_connects_with_all_its_default_variables(robot: VirtualRobot) -> None:
    code = f"""
import json, time
from rtde_receive import RTDEReceiveInterface
from rtde_io import RTDEIOInterface
receive, io = RTDEReceiveInterface({robot.host!r}, 500.0), RTDEIOInterface({robot.host!r})
first = receive.getTimestamp()
while receive.getTimestamp() == first:
    time.sleep(0.001)
print(json.dumps([receive.getActualTCPPose(), receive.getTargetQ(), receive.getSafetyMode(),
                  receive.getOutputDoubleRegister(16), io.setInputIntRegister(18, 1)]))
io.disconnect(); receive.disconnect()
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=600, check=True)
    pose, joints, safety, radius_mm, written = json.loads(done.stdout.strip().splitlines()[-1])
    assert np.linalg.norm(np.array(pose[:3]) - [-0.55, 0, 0.075]) == pytest.approx(0.1, abs=0.002)
    assert len(joints) == 6
    assert (safety, radius_mm, written) == (1, 100.0, True)


def test_recording_of_a_finished_run_and_unknown_commands(
    robot: VirtualRobot, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("runs") / "run.npz"
    answer = robot.do("recording", path=str(path))
    while "error" in answer:
        assert answer["error"] == "no program has ended yet"
        answer = robot.do("recording", path=str(path))
    with np.load(path) as stored:
        start, end = stored["window"]
        inside = stored["deviation_mm"][start:end]
    assert answer["samples"] > len(inside) > 50
    assert 0 < np.abs(inside).max() < 1
    assert "unknown command" in robot.do("dance")["error"]
    assert "error" in robot.do("stall")
    assert robot.do("status")["programs"] >= 2


def test_other_than_loopback_is_refused() -> None:
    command = [sys.executable, "-m", "studies.machines.rtde_server", "--host=192.0.2.1", "--port=0"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 1
    assert "error[rtde.host]" in done.stderr
