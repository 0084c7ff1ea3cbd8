"""States of a control that speaks no RTDE: lines of JSON over TCP, from a bridge beside it.

Each line is one object with the names of ``dtwin.links.layout``. The bridge is the user's: it reads
the control by its maker's library and serves the newest state to whoever connects.
"""

from __future__ import annotations

import json
import math

from dtwin.links import layout
from dtwin.links._line_socket import LineSocket, StateLines

_REQUIRED: tuple[str, ...] = (
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


class StateFeed(StateLines):
    """The newest state that a bridge sends; ``address``: ``HOST:PORT`` of the bridge."""

    def __init__(self, address: str) -> None:
        super().__init__(LineSocket(address, "state feed", _LONGEST_LINE))

    def _take(self, lines: list[bytes]) -> bool:
        """Keep the last line that is a state; tell whether there was one."""
        taken = False
        for line in reversed(lines):
            if not taken:
                taken = self._read(line)
        return taken

    def _read(self, line: bytes) -> bool:
        try:
            given = json.loads(line)
            values = {layout.INDEX[name]: float(value) for name, value in given.items()}
            whole = all(name in given for name in _REQUIRED)
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
            values, whole = {}, False
        if not whole or not all(map(math.isfinite, values.values())):
            return False
        self._state[:] = 0.0
        self._state[layout.SPEED_SCALING] = 1.0
        for place, value in values.items():
            self._state[place] = value
        return True
