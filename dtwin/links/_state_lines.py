"""The newest state that a program beside a control sends, line by line: what every such link shares."""

from __future__ import annotations

import math
import time
from abc import abstractmethod

from dtwin.links import state as layout
from dtwin.links._line_socket import LineSocket
from dtwin.links.opened import OpenAndClose


class StateLines(OpenAndClose):
    """States over one connection.

    ``lost_after_s``: silence after which the other end counts as dead, as behind a half-open connection.
    ``received_s``: monotonic time of the newest state.
    """

    def __init__(self, line: LineSocket, lost_after_s: float) -> None:
        self._line, self._lost_after_s = line, lost_after_s
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
