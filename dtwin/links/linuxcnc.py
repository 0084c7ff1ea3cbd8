"""Live corrections for LinuxCNC: external offsets of its axes, through a bridge beside it.

The values go first and a sequence number last; a component in LinuxCNC's own servo thread latches
them, limits and slews them, and goes to zero by itself when the number stops changing.
"""

from __future__ import annotations

import json
import socket
import time
from pathlib import Path
from typing import Any

import numpy as np

from dtwin.errors import DeviceError
from dtwin.links import layout
from dtwin.links.layout import Floats
from dtwin.links.opened import OpenAndClose

_ANSWER_S = 20.0
_EVERY_CYCLES = 2
PERIOD_S = 0.002
"""Between two states: two cycles of the servo thread."""
_NO_RADIUS_MM = -1.0
_NUMBER, _DIRECTION, _RADIUS, _CENTRE, _PLANE, _FEED = 0, 1, 2, 3, 6, 7


class Bridge(OpenAndClose):
    """A connection to a session's bridge."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._socket: socket.socket | None = None
        self._rest = b""

    def open(self) -> None:
        """Connect. Raises ``DeviceError`` when nothing answers there."""
        connection = socket.socket(socket.AF_UNIX)
        connection.settimeout(_ANSWER_S)
        try:
            connection.connect(str(self.path))
        except OSError as error:
            connection.close()
            raise DeviceError(
                "LinuxCNC's bridge is not there", code="linuxcnc.bridge", where=str(self.path), got=str(error)
            ) from error
        self._socket = connection

    def close(self) -> None:
        """Go away; a correction that was sent is dropped by the component's watchdog."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def tell(self, **request: Any) -> None:
        """Send a request that has no answer."""
        if self._socket is None:
            raise DeviceError("the bridge is closed", code="linuxcnc.bridge")
        try:
            self._socket.sendall(json.dumps(request).encode() + b"\n")
        except OSError as error:
            raise _gone(self.path, error) from error

    def ask(self, **request: Any) -> dict[str, Any]:
        """Send a request and return its answer.

        Raises ``DeviceError`` when the bridge is gone, silent, or could not do it.
        """
        self.tell(**request)
        assert self._socket is not None
        while b"\n" not in self._rest:
            try:
                part = self._socket.recv(65536)
            except OSError as error:
                raise _gone(self.path, error) from error
            if not part:
                raise _gone(self.path, None)
            self._rest += part
        line, _, self._rest = self._rest.partition(b"\n")
        said: dict[str, Any] = json.loads(line)
        if "error" in said:
            raise DeviceError(
                "LinuxCNC did not do what it was told",
                code="linuxcnc.refused",
                where=str(request.get("do")),
                got=str(said["error"])[:300],
            )
        return said


class LinuxcncLink:
    """State and correction of a running LinuxCNC, as the serving loop wants them.

    Attributes:
        trips (int): How often the component dropped a correction since it was loaded.
        circles_seen (int): How many circles have begun since the link was made.
        in_circle (bool): Whether one is being run.
    """

    def __init__(self, bridge: Bridge) -> None:
        self.bridge = bridge
        self.trips = 0
        self.circles_seen = 0
        self.in_circle = False
        self._received_s = -np.inf
        self._state = layout.empty_state()

    @property
    def received_s(self) -> float:
        """Monotonic time at which the newest state was received."""
        return self._received_s

    def wait_state(self, timeout_s: float) -> Floats | None:
        """Return the newest state (N,), two servo cycles after the last one, or None.

        Raises ``DeviceError`` when the bridge is gone.
        """
        said = self.bridge.ask(do="wait", cycles=_EVERY_CYCLES, timeout_s=timeout_s)["state"]
        if said is None:
            return None
        self._received_s = time.monotonic()
        self.trips = int(said["trips"])
        state, told = self._state, said["context"]
        running = told[_NUMBER] > 0.0
        self.circles_seen += int(running and not self.in_circle)
        self.in_circle = running
        state[layout.TIMESTAMP] = said["t_s"]
        state[layout.TARGET_TCP : layout.TARGET_TCP + 3] = said["position_mm"]
        state[layout.ACTUAL_TCP : layout.ACTUAL_TCP + 3] = said["actual_mm"]
        state[layout.TARGET_SPEED : layout.TARGET_SPEED + 3] = said["speed_mm_s"]
        state[layout.SPEED_SCALING] = state[layout.RUNTIME_RUNNING] = 1.0
        state[layout.SAFETY_OK] = float(said["enabled"])
        state[layout.SEGMENT_ID] = told[_NUMBER]
        # Between circles there is no radius: outside of every box, so that nothing is corrected.
        state[layout.RADIUS] = told[_RADIUS] if running else _NO_RADIUS_MM
        state[layout.PLANE_ID], state[layout.FEED] = told[_PLANE], told[_FEED]
        state[layout.DIRECTION_SIGN] = told[_DIRECTION] if running else 1.0
        state[layout.CENTRE : layout.CENTRE + 3] = told[_CENTRE : _CENTRE + 3]
        state[layout.APPLIED_SEQUENCE] = said["latched"]
        state[layout.APPLIED : layout.APPLIED + 3] = [1e3 * v for v in said["applied_mm"]]
        return state

    def send(self, offset_um: Floats, sequence: int) -> None:
        """Send a correction (3,) in um along x, y, z.

        Args:
            offset_um: Correction. Shape (3,).
            sequence: Differs from the one before.
        """
        x, y, z = offset_um.tolist()
        self.bridge.tell(do="send", offset_um=[x, y, z], sequence=sequence)


def _gone(path: Path, error: OSError | None) -> DeviceError:
    return DeviceError(
        "LinuxCNC's bridge went away",
        code="linuxcnc.bridge",
        where=str(path),
        got=str(error) if error else "end of the connection",
    )
