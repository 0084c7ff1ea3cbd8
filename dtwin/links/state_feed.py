"""States of a control that speaks no RTDE: lines of JSON over TCP, from a bridge beside it.

Each line is one object with the names of ``dtwin.links.state``. The bridge is the user's: it reads
the control by its maker's library and serves the newest state to whoever connects.
"""

from __future__ import annotations

import contextlib
import json
import math
import select
import socket
import time

from dtwin.errors import DeviceError, InputError
from dtwin.links import state as layout
from dtwin.links.opened import OpenAndClose

REQUIRED: tuple[str, ...] = (
    "timestamp_s",
    *(f"target_tcp_{axis}_mm" for axis in "xyz"),
    *(f"target_speed_{axis}_mm_s" for axis in "xyz"),
    "runtime_running",
    "safety_ok",
    "segment_id",
    "plane_id",
    *(f"centre_{axis}_mm" for axis in "xyz"),
    "radius_mm",
    "direction_sign",
    "feed_mm_min",
)
"""Names that every line must have."""

_LONGEST_LINE = 8192
_CONNECT_S = 2.0


class StateFeed(OpenAndClose):
    """The newest state that a bridge sends.

    Parameters
    ----------
    address : str
        ``HOST:PORT`` of the bridge.
    lost_after_s : float
        Silence after which the feed counts as dead, as behind a half-open connection.

    Attributes
    ----------
    bad_lines : int
        Lines that were no state, since the beginning.
    received_s : float
        Monotonic time of the newest state.
    """

    def __init__(self, address: str, *, lost_after_s: float = 2.0) -> None:
        host, _, port = address.rpartition(":")
        if not host or not port.isdigit() or not 0 < int(port) < 65536:
            raise InputError(
                "this is no address of a state feed", code="states.address", got=address[:80],
                allowed="HOST:PORT",
            )  # fmt: skip
        self.address, self._place = address, (host, int(port))
        self._lost_after_s = lost_after_s
        self._socket: socket.socket | None = None
        self._held = b""
        self._state = layout.empty_state()
        self.bad_lines = 0
        self.received_s = self._heard_s = math.nan

    @property
    def newest(self) -> layout.RobotState:
        """State (N,) that was returned last."""
        return self._state

    def open(self) -> None:
        """Connect.

        Raises
        ------
        DeviceError
            When nobody answers.
        """
        if self._socket is not None:
            return
        try:
            self._socket = socket.create_connection(self._place, _CONNECT_S)
        except OSError as error:
            raise self._fault("states.absent", f"no state feed answers ({error})") from error
        self._socket.setblocking(False)
        self._held, self._heard_s = b"", time.monotonic()

    def wait_state(self, timeout_s: float) -> layout.RobotState | None:
        """Return the newest state that was not returned before, None when none came in time.

        Raises
        ------
        DeviceError
            When the bridge closed the connection, or was silent for too long.
        """
        until_s = time.monotonic() + timeout_s
        while True:
            if self._socket is None:
                raise self._fault("states.closed", "the state feed is not open")
            left_s = max(until_s - time.monotonic(), 0.0)
            ready, _, _ = select.select([self._socket], [], [], left_s)
            if ready and self._take(self._socket):
                return self._state
            now_s = time.monotonic()
            if now_s - self._heard_s > self._lost_after_s:
                text = f"the state feed sent no state for {now_s - self._heard_s:.1f} s"
                raise self._fault("states.silent", text)
            if now_s >= until_s:
                return None

    def close(self) -> None:
        """Close the connection; safe to call twice."""
        held, self._socket = self._socket, None
        if held is not None:
            held.close()

    def _take(self, connection: socket.socket) -> bool:
        """Read what has come; tell whether the last whole line that is a state is a new one."""
        received = b""
        with contextlib.suppress(BlockingIOError):
            try:
                received = connection.recv(1 << 16)
            except BlockingIOError:
                raise
            except OSError as error:
                raise self._fault("states.lost", f"the state feed broke ({error})") from error
            if not received:
                raise self._fault("states.lost", "the state feed closed the connection")
        *lines, self._held = (self._held + received).split(b"\n")
        if len(self._held) > _LONGEST_LINE:
            self._held = b""
            self.bad_lines += 1
        found = False
        for line in reversed(lines):
            if not found:
                found = self._read(line)
        if found:
            self.received_s = self._heard_s = time.monotonic()
        return found

    def _read(self, line: bytes) -> bool:
        try:
            given = json.loads(line)
            values = {layout.INDEX[name]: float(value) for name, value in given.items()}
            whole = all(name in given for name in REQUIRED)
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
            values, whole = {}, False
        if not whole or not all(map(math.isfinite, values.values())):
            self.bad_lines += 1
            return False
        self._state[:] = 0.0
        self._state[layout.SPEED_SCALING] = 1.0
        for place, value in values.items():
            self._state[place] = value
        return True

    def _fault(self, code: str, text: str) -> DeviceError:
        return DeviceError(
            text, code=code, where=f"state feed at {self.address}",
            hint="check the bridge beside the control, then serve again",
        )  # fmt: skip
