"""A virtual control that sends its axes' state and takes live offsets, over a real connection.

It speaks the axis link as a bridge beside a real control would. On the machine clock it waits for the
correction of each state; on the wall clock it goes on, and back to zero when nothing comes.
"""

from __future__ import annotations

import contextlib
import json
import math
import select
import socket
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np

from dtwin.errors import DeviceError
from dtwin.links.axis_link import LONGEST_LINE, PROTOCOL
from dtwin.progress import Progress
from dtwin.schema import Floats

_WATCHDOG_S = 0.1
Clock = Literal["wall", "machine"]
_AXES = ("x", "y", "z")
_POLL_S = 0.2
_Prove = Callable[[str], str]
_Announce = Callable[[str], None]


class AxisMachine(Protocol):
    """What the server moves: a machine that runs a program, tick by tick."""

    @property
    def name(self) -> str:
        """Of the control."""

    @property
    def period_s(self) -> float:
        """From tick to tick."""

    @property
    def axes(self) -> tuple[str, ...]:
        """Axes that take an offset."""

    @property
    def provides(self) -> tuple[str, ...]:
        """Names of inputs and channels that it can send."""

    @property
    def channels_hz(self) -> float:
        """Rate of its channels, 0 when it has none."""

    @property
    def ticks(self) -> int:
        """Length of the program."""

    def state(self, tick: int) -> Mapping[str, float]:
        """Return what is sent before a tick: its time, inputs, channels."""

    def advance(self, tick: int, offset_um: Floats) -> None:
        """Make a tick with an offset (3,) in force."""


class ServedMachine(AxisMachine, Protocol):
    """A machine whose measurements become a campaign folder."""

    def write(self, folder: Path) -> str:
        """Write what was measured; return what it was."""


class AxisServer:
    """One machine, one client at a time.

    ``prove``: answers a nonce; see :mod:`dtwin.links.virtual_key`.
    ``clock``: as in the module's description.
    ``port``: on loopback; 0 takes a free one.
    ``watchdog_trips``: how often the correction went to zero because nothing came.
    """

    def __init__(self, machine: AxisMachine, prove: _Prove, *, clock: Clock = "machine", port: int = 0) -> None:
        self._machine, self._prove, self._clock = machine, prove, clock
        self._listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            self._listener.bind(("127.0.0.1", port))
        except OSError as error:
            self._listener.close()
            raise DeviceError(
                "the virtual control cannot listen",
                code="axes.port",
                where=f"127.0.0.1:{port}",
                got=str(error),
                hint="another port: --listen PORT, or 0 for a free one",
            ) from error
        self._listener.listen(4)
        self.port = int(self._listener.getsockname()[1])
        self.watchdog_trips = 0
        self._client: _Client | None = None
        self._offset_um, self._sequence = np.zeros(3), 0
        self._let_go = False
        self._heard_s = -math.inf

    def close(self) -> None:
        """Send everybody away and free the port."""
        if self._client is not None:
            self._client.close()
        self._listener.close()

    def run(self, announce: _Announce, progress: Progress) -> None:
        """Run the machine's program once, corrected by whoever connects.

        It begins when the first client has connected. A client that goes leaves no correction
        behind; on the machine clock the program then waits for the next one.
        """
        self._wait_for_client(announce)
        begun_s = time.monotonic()
        total = self._machine.ticks
        for tick in range(total):
            while not self._tick(tick, begun_s):
                self._wait_for_client(announce)
            self._machine.advance(tick, self._offset_um)
            if tick % max(1, total // 200) == 0:
                progress(tick, total, f"{tick * self._machine.period_s:z.1f} s of the program")
        progress(total, total, "the program has ended")
        self._farewell(total)

    def _tick(self, tick: int, begun_s: float) -> bool:
        """Send a state and take what is due; tell whether the machine may make the tick."""
        if self._clock == "wall":
            wait_s = begun_s + tick * self._machine.period_s - time.monotonic()
            self._listen(max(wait_s, 0.0))
            if self._client is not None:
                self._say(self._state(tick))
            if self._offset_um.any() and time.monotonic() - self._heard_s > _WATCHDOG_S:
                self._drop()
                self._let_go = True
                self.watchdog_trips += 1
            return True
        self._say(self._state(tick))
        while self._client is not None and not self._take(self._client.lines(_POLL_S)):
            self._refuse_others()
        return self._client is not None

    def _state(self, tick: int) -> dict[str, float]:
        x, y, z = self._offset_um.tolist()
        return {
            "timestamp_s": tick * self._machine.period_s,
            **self._machine.state(tick),
            "runtime_running": 1,
            "safety_ok": 1,
            "applied_sequence": self._sequence,
            "applied_x_um": x,
            "applied_y_um": y,
            "applied_z_um": z,
        }

    def _farewell(self, tick: int) -> None:
        if self._client is None:
            return
        last = {"timestamp_s": tick * self._machine.period_s, "runtime_running": 0, "safety_ok": 1}
        self._say({**last, "applied_sequence": self._sequence, "finished": 1})
        until_s = time.monotonic() + 2.0
        # The client leads its correction to zero before it goes.
        while self._client is not None and time.monotonic() < until_s:
            self._take(self._client.lines(_POLL_S))

    def _say(self, values: Mapping[str, float]) -> None:
        client = self._client
        if client is not None:
            wanted = client.wanted
            client.send({k: v for k, v in values.items() if k in wanted or k in _ALWAYS})
            self._keep()

    def _take(self, lines: Sequence[bytes]) -> bool:
        """Use the corrections that came; tell whether there was one."""
        taken = False
        for line in lines:
            correction = _correction(line)
            if correction is None:
                continue
            taken = True
            sequence, offset = correction
            self._heard_s = time.monotonic()
            # What it dropped comes back only from zero.
            if sequence != self._sequence and not (self._let_go and offset.any()):
                self._sequence, self._let_go = sequence, False
                allowed = [axis in self._machine.axes for axis in _AXES]
                self._offset_um = np.where(allowed, offset, 0.0)
        self._keep()
        return taken

    def _listen(self, wait_s: float) -> None:
        """Take corrections and newcomers until the next tick is due."""
        until_s = time.monotonic() + wait_s
        while True:
            sockets = [self._listener]
            if self._client is not None:
                sockets.append(self._client.socket)
            ready, _, _ = select.select(sockets, [], [], max(until_s - time.monotonic(), 0.0))
            if self._listener in ready:
                self._admit()
            if self._client is not None and self._client.socket in ready:
                self._take(self._client.lines(0.0))
            if time.monotonic() >= until_s:
                return

    def _wait_for_client(self, announce: _Announce) -> None:
        if self._client is None:
            announce(f"{self._machine.name} waits for dtwin serve at 127.0.0.1:{self.port}")
        while self._client is None:
            if select.select([self._listener], [], [], _POLL_S)[0]:
                self._admit()

    def _refuse_others(self) -> None:
        if select.select([self._listener], [], [], 0.0)[0]:
            self._admit()

    def _admit(self) -> None:
        connection, _ = self._listener.accept()
        client = _Client(connection)
        hello = client.hello()
        if hello is None:
            client.close()
            return
        provides = self._machine.provides
        if self._client is not None:
            client.send({"dtwin": PROTOCOL, "refused": "another client corrects this control"})
            client.close()
            return
        asked = [*hello["inputs"], *hello["channels"]]
        rate_differs = hello["channels"] and hello["channels_hz"] != self._machine.channels_hz
        client.wanted = frozenset(asked)
        client.send(
            {
                "dtwin": PROTOCOL,
                "control": self._machine.name,
                "period_s": self._machine.period_s,
                "clock": self._clock,
                "watchdog_s": _WATCHDOG_S,
                "axes": list(self._machine.axes),
                "missing": [name for name in asked if name not in provides]
                + ([f"channels at {hello['channels_hz']:g} Hz"] if rate_differs else []),
                "proof": self._prove(hello["nonce"]),
            }
        )
        self._client = None if client.gone else client
        self._sequence, self._let_go = 0, False
        self._heard_s = time.monotonic()

    def _keep(self) -> None:
        """Forget a client that has gone, and its correction."""
        if self._client is not None and self._client.gone:
            self._client.close()
            self._client = None
            self._drop()

    def _drop(self) -> None:
        self._offset_um, self._sequence = np.zeros(3), 0


_ALWAYS = frozenset(
    (
        "timestamp_s",
        "runtime_running",
        "safety_ok",
        "segment_id",
        "applied_sequence",
        "applied_x_um",
        "applied_y_um",
        "applied_z_um",
        "finished",
    )
)


class _Client:
    """The other end of a connection."""

    def __init__(self, connection: socket.socket) -> None:
        self.socket = connection
        connection.settimeout(_POLL_S)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.gone = False
        self.wanted: frozenset[str] = frozenset()
        self._held = b""

    def hello(self) -> dict[str, Any] | None:
        """Return what the client asks for, None when it is no client of ours."""
        for line in self.lines(1.0):
            with contextlib.suppress(ValueError, TypeError, KeyError, RecursionError):
                said = json.loads(line)
                wanted = {name: [str(n) for n in said[name]] for name in ("inputs", "channels")}
                if said["dtwin"] == PROTOCOL:
                    rate = float(said["channels_hz"])
                    return {**wanted, "channels_hz": rate, "nonce": str(said["nonce"])[:64]}
        return None

    def lines(self, wait_s: float) -> list[bytes]:
        """Return the lines that came within a time, none when the client has gone."""
        if not select.select([self.socket], [], [], wait_s)[0]:
            return []
        try:
            received = self.socket.recv(1 << 16)
        except OSError:
            received = b""
        self.gone = self.gone or not received
        *contents, self._held = (self._held + received).split(b"\n")
        if len(self._held) > LONGEST_LINE:
            self._held = b""
        return contents

    def send(self, values: Mapping[str, object]) -> None:
        """Send an object; a client that does not read has gone."""
        try:
            self.socket.sendall(json.dumps(values).encode() + b"\n")
        except OSError:
            self.gone = True

    def close(self) -> None:
        self.socket.close()


def _correction(line: bytes) -> tuple[int, Floats] | None:
    with contextlib.suppress(ValueError, TypeError, KeyError, RecursionError):
        said = json.loads(line)
        offset = np.array([float(value) for value in said["offset_um"]])
        if offset.shape == (3,) and np.isfinite(offset).all():
            return int(said["sequence"]), offset
    return None
