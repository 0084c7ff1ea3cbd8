"""States of a control that speaks no RTDE: lines of JSON over TCP, from a bridge beside it.

Each line is one object with the names of ``dtwin.links.state``. The bridge is the user's: it reads
the control by its maker's library and serves the newest state to whoever connects.
"""

from __future__ import annotations

import json
import math
import time

from dtwin.links import state as layout
from dtwin.links.line_socket import LineSocket
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
    received_s : float
        Monotonic time of the newest state.
    """

    def __init__(self, address: str, *, lost_after_s: float = 2.0) -> None:
        self._line = LineSocket(address, "state feed", _LONGEST_LINE)
        self._lost_after_s = lost_after_s
        self._state = layout.empty_state()
        self._bad_lines = 0
        self.received_s = self._heard_s = math.nan

    @property
    def bad_lines(self) -> int:
        """Lines that were no state, since the beginning."""
        return self._bad_lines + self._line.overlong

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
        if not self._line.connected:
            self._line.open()
            self._heard_s = time.monotonic()

    def wait_state(self, timeout_s: float) -> layout.RobotState | None:
        """Return the newest state that was not returned before, None when none came in time.

        Raises
        ------
        DeviceError
            When the bridge closed the connection, or was silent for too long.
        """
        until_s = time.monotonic() + timeout_s
        while True:
            if self._take(self._line.lines(until_s)):
                return self._state
            now_s = time.monotonic()
            if now_s - self._heard_s > self._lost_after_s:
                text = f"the state feed sent no state for {now_s - self._heard_s:.1f} s"
                raise self._line.fault("states.silent", text)
            if now_s >= until_s:
                return None

    def close(self) -> None:
        """Close the connection; safe to call twice."""
        self._line.close()

    def _take(self, lines: list[bytes]) -> bool:
        """Keep the last line that is a state; tell whether there was one."""
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
            self._bad_lines += 1
            return False
        self._state[:] = 0.0
        self._state[layout.SPEED_SCALING] = 1.0
        for place, value in values.items():
            self._state[place] = value
        return True
