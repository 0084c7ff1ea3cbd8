"""A proxy before the virtual robot that alters the states on their way."""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Callable
from types import TracebackType
from typing import Self

import numpy as np
from virtual_robot import RTDE_PORT, free_address

_HEADER = struct.Struct(">HB")
_SETUP_OUTPUTS, _DATA = 79, 85
_FORMATS = {"DOUBLE": "d", "VECTOR6D": "6d", "INT32": "i", "UINT32": "I", "UINT64": "Q"}

Fields = dict[str, tuple[int, str]]
"""Name of a variable -> its place in a packet, and its format."""
Spoil = Callable[[bytearray, Fields], list[bytes]]
"""What becomes of the payload of one state: payloads to send, none, one or more."""


def put(payload: bytearray, fields: Fields, name: str, *values: float) -> None:
    """Overwrite one variable; a single value fills a vector."""
    at, form = fields[name]
    count = int(form[:-1] or 1)
    struct.pack_into(f">{form}", payload, at, *(values * count if len(values) == 1 else values))


def take(payload: bytes, fields: Fields, name: str) -> tuple[float, ...]:
    """Read one variable."""
    at, form = fields[name]
    return struct.unpack_from(f">{form}", payload, at)


class RtdeProxy:
    """Passes on what robot and clients say; ``spoil`` alters the robot's states."""

    def __init__(self, robot_host: str) -> None:
        self.host = free_address()
        self._robot_host = robot_host
        self._listener = socket.create_server((self.host, RTDE_PORT))
        self.spoil: Spoil | None = None
        self.raw: Callable[[bytes], bytes] | None = None
        self._threads = [threading.Thread(target=self._accept, daemon=True)]
        self._sockets: list[socket.socket] = []

    def __enter__(self) -> Self:
        self._threads[0].start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for one in (self._listener, *self._sockets):
            _end(one)
            one.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                client, _ = self._listener.accept()
                robot = socket.create_connection((self._robot_host, RTDE_PORT))
                for one in (client, robot):
                    one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._sockets += [client, robot]
                names: list[str] = []
                for pump in (self._upwards, self._downwards):
                    threading.Thread(target=pump, args=(client, robot, names), daemon=True).start()

    def _upwards(self, client: socket.socket, robot: socket.socket, names: list[str]) -> None:
        with contextlib.suppress(OSError, ConnectionError):
            while True:
                kind, payload = _frame(client)
                if kind == _SETUP_OUTPUTS:
                    names[:] = payload[8:].decode().split(",")
                robot.sendall(_HEADER.pack(_HEADER.size + len(payload), kind) + payload)
        _end(robot)

    def _downwards(self, client: socket.socket, robot: socket.socket, names: list[str]) -> None:
        fields: Fields = {}
        with contextlib.suppress(OSError, ConnectionError):
            while True:
                kind, payload = _frame(robot)
                sent = [payload]
                if kind == _SETUP_OUTPUTS:
                    fields = _fields(names, payload)
                elif kind == _DATA and self.spoil is not None and "timestamp" in fields:
                    sent = self.spoil(bytearray(payload), fields)
                for one in sent:
                    whole = _HEADER.pack(_HEADER.size + len(one), kind) + one
                    spoiled = self.raw if kind == _DATA else None
                    client.sendall(whole if spoiled is None else spoiled(whole))
        _end(client)


def _end(one: socket.socket) -> None:
    # A descriptor that another thread reads from is not closed by closing it.
    with contextlib.suppress(OSError):
        one.shutdown(socket.SHUT_RDWR)


def _fields(names: list[str], reply: bytes) -> Fields:
    found, at = {}, 1
    for name, kind in zip(names, reply[1:].decode().split(","), strict=False):
        if kind not in _FORMATS:
            return {}
        found[name] = (at, _FORMATS[kind])
        at += struct.calcsize(f">{_FORMATS[kind]}")
    return found


def _frame(source: socket.socket) -> tuple[int, bytes]:
    size, kind = _HEADER.unpack(_exactly(source, _HEADER.size))
    return kind, _exactly(source, size - _HEADER.size)


def _exactly(source: socket.socket, size: int) -> bytes:
    held = b""
    while len(held) < size:
        received = source.recv(size - len(held))
        if not received:
            raise ConnectionError
        held += received
    return held


# What may be done to states.


def filled(value: float) -> Spoil:
    """Every pose and joint, and their rates, of one value."""

    def spoil(payload: bytearray, fields: Fields) -> list[bytes]:
        for name in fields:
            if name.startswith(("target_", "actual_")) and name != "target_speed_fraction":
                put(payload, fields, name, value)
        return [bytes(payload)]

    return spoil


def variable(name: str, *values: float) -> Spoil:
    """One variable overwritten."""

    def spoil(payload: bytearray, fields: Fields) -> list[bytes]:
        put(payload, fields, name, *values)
        return [bytes(payload)]

    return spoil


def first_joint(value: float) -> Spoil:
    """Only one joint wrong, which no model uses."""

    def spoil(payload: bytearray, fields: Fields) -> list[bytes]:
        joints = take(payload, fields, "actual_q")
        put(payload, fields, "actual_q", value, *joints[1:])
        return [bytes(payload)]

    return spoil


def wild_stamps(seed: int = 0) -> Spoil:
    """Stamps that jump back by up to two seconds."""
    rng = np.random.default_rng(seed)

    def spoil(payload: bytearray, fields: Fields) -> list[bytes]:
        (stamp,) = take(payload, fields, "timestamp")
        put(payload, fields, "timestamp", stamp - float(rng.uniform(0.0, 2.0)))
        return [bytes(payload)]

    return spoil


class Replay:
    """The states of some time ago, once it is switched on; at first, in their turn, when nothing is kept."""

    def __init__(self, age_s: float, *, on: bool) -> None:
        self.age_s, self.on = age_s, on
        self._kept: deque[tuple[float, bytes]] = deque()

    def __call__(self, payload: bytearray, fields: Fields) -> list[bytes]:
        now = time.monotonic()
        self._kept.append((now, bytes(payload)))
        old = self._kept[0][1]
        while self._kept and now - self._kept[0][0] > self.age_s:
            old = self._kept.popleft()[1]
        return [old if self.on else bytes(payload)]


def twice(payload: bytearray, fields: Fields) -> list[bytes]:
    """Every state two times."""
    return [bytes(payload), bytes(payload)]


def wild_registers(seed: int = 0) -> Spoil:
    """Output registers of any value, but for the number of the correction in force."""
    rng = np.random.default_rng(seed)

    def spoil(payload: bytearray, fields: Fields) -> list[bytes]:
        for name in fields:
            if name.startswith("output_double"):
                put(payload, fields, name, float(10.0 ** rng.uniform(-3, 3)))
        return [bytes(payload)]

    return spoil


def withheld(payload: bytearray, fields: Fields) -> list[bytes]:
    """Nothing more."""
    return []


def flipped(seed: int = 0) -> Callable[[bytes], bytes]:
    """A bit of every tenth packet turned, anywhere."""
    rng = np.random.default_rng(seed)

    def spoil(whole: bytes) -> bytes:
        if rng.random() > 0.1:
            return whole
        out = bytearray(whole)
        out[int(rng.integers(len(out)))] ^= 1 << int(rng.integers(8))
        return bytes(out)

    return spoil


def cut(whole: bytes) -> bytes:
    """The first half of every packet."""
    return whole[: len(whole) // 2]
