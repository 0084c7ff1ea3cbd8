"""Lines over TCP, read without blocking: what state feeds and axis links share, the newest state among it."""

from __future__ import annotations

import contextlib
import math
import select
import socket
import time
from abc import abstractmethod

from dtwin.errors import DeviceError, InputError
from dtwin.links import layout
from dtwin.links.opened import OpenAndClose

_CONNECT_S = 2.0
_CHUNK = 1 << 16
# Silence after which the other end counts as dead, as behind a half-open connection.
_LOST_AFTER_S = 2.0


class LineSocket:
    """A connection whose other end sends lines.

    ``address``: ``HOST:PORT``.
    ``longest``: a line of more bytes is thrown away.
    """

    def __init__(self, address: str, what: str, longest: int) -> None:
        host, _, port = address.rpartition(":")
        if not host or not port.isdigit() or not 0 < int(port) < 65536:
            raise InputError(
                f"this is no address of a {what}", code="states.address", got=address[:80], allowed="HOST:PORT"
            )
        self.address, self.host, self._what = address, host, what
        self._place, self._longest = (host, int(port)), longest
        self._socket: socket.socket | None = None
        self._held = b""

    @property
    def connected(self) -> bool:
        """Whether it was opened and not closed."""
        return self._socket is not None

    def open(self) -> None:
        """Connect. Raises ``DeviceError`` when nobody answers."""
        if self._socket is not None:
            return
        try:
            self._socket = socket.create_connection(self._place, _CONNECT_S)
        except OSError as error:
            raise self.fault("states.absent", f"no {self._what} answers ({error})") from error
        self._socket.setblocking(False)
        # One small line at a time, and each is waited for.
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._held = b""

    def lines(self, until_s: float) -> list[bytes]:
        """Return the whole lines that have come, waiting for the first until a monotonic time."""
        while True:
            if self._socket is None:
                raise self.fault("states.closed", f"the {self._what} is not open")
            left_s = max(until_s - time.monotonic(), 0.0)
            ready, _, _ = select.select([self._socket], [], [], left_s)
            lines = self._received(self._socket) if ready else []
            if lines or time.monotonic() >= until_s:
                return lines

    def send(self, line: bytes) -> None:
        """Send a line, its end included, without waiting.

        Raises ``DeviceError`` when the other end does not read, or the connection is broken.
        """
        if self._socket is None:
            raise self.fault("states.closed", f"the {self._what} is not open")
        try:
            sent = self._socket.send(line)
        except BlockingIOError as error:
            raise self.fault("states.full", f"the {self._what} reads nothing") from error
        except OSError as error:
            raise self.fault("states.lost", f"the {self._what} broke ({error})") from error
        if sent != len(line):
            raise self.fault("states.full", f"the {self._what} reads too slowly")

    def close(self) -> None:
        """Close the connection; safe to call twice."""
        held, self._socket = self._socket, None
        if held is not None:
            held.close()

    def fault(self, code: str, text: str, got: str | None = None) -> DeviceError:
        """Return an error about this connection."""
        return DeviceError(
            text,
            code=code,
            where=f"{self._what} at {self.address}",
            got=got,
            hint="check the program beside the control, then serve again",
        )

    def _received(self, connection: socket.socket) -> list[bytes]:
        received = b""
        with contextlib.suppress(BlockingIOError):
            try:
                received = connection.recv(_CHUNK)
            except BlockingIOError:
                raise
            except OSError as error:
                raise self.fault("states.lost", f"the {self._what} broke ({error})") from error
            if not received:
                raise self.fault("states.lost", f"the {self._what} closed the connection")
        *lines, self._held = (self._held + received).split(b"\n")
        if len(self._held) > self._longest:
            self._held = b""
        return lines


class StateLines(OpenAndClose):
    """States over one connection.

    ``received_s``: monotonic time of the newest state.
    """

    def __init__(self, line: LineSocket) -> None:
        self._line, self._lost_after_s = line, _LOST_AFTER_S
        self._state = layout.empty_state()
        self._state[layout.SPEED_SCALING] = 1.0
        self.received_s = self._heard_s = math.nan

    @property
    def newest(self) -> layout.RobotState:
        """State (N,) that was returned last."""
        return self._state

    def open(self) -> None:
        """Connect. Raises ``DeviceError`` when nobody answers."""
        if not self._line.connected:
            self._line.open()
            self._heard_s = time.monotonic()

    def wait_state(self, timeout_s: float) -> layout.RobotState | None:
        """Return the newest state that was not returned before, None when none came in time."""
        until_s = time.monotonic() + timeout_s
        while True:
            if self._take(self._lines(until_s)):
                self.received_s = self._heard_s = time.monotonic()
                return self._state
            now_s = time.monotonic()
            if now_s - self._heard_s > self._lost_after_s:
                text = f"no state has come for {now_s - self._heard_s:z.1f} s"
                raise self._line.fault("states.silent", text)
            if now_s >= until_s:
                return None

    def close(self) -> None:
        """Close the connection; safe to call twice."""
        self._line.close()

    def _lines(self, until_s: float) -> list[bytes]:
        return self._line.lines(until_s)

    @abstractmethod
    def _take(self, lines: list[bytes]) -> bool:
        """Use whole lines that came; tell whether there was a state among them."""
