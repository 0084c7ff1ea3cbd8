"""The robot's controller as an instrument: its states by its own clock, losses counted."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from dtwin.acquire.instrument import Description, Reading
from dtwin.errors import DeviceError
from dtwin.links import layout
from dtwin.links.opened import OpenAndClose
from dtwin.links.ur import UrLink
from dtwin.schema import Finding, Floats

_GROUP = "controller"
_LOST_STATES = "states missing by the controller's clock"

_WHOLE = ("segment_id", "applied_sequence", "runtime_running", "safety_ok")
_COLUMNS: dict[str, np.dtype[Any]] = {
    "timestamp_s": np.dtype(np.float64),
    "segment_time_s": np.dtype(np.float64),
    **{
        name: np.dtype(np.float64)
        for name in layout.NAMES
        if name.startswith(("target_", "actual_", "applied_")) and name not in _WHOLE
    },
    **{name: np.dtype(np.int64) for name in _WHOLE},
}
"""What is recorded of a state."""


class RobotRecorder(OpenAndClose):
    """Records a robot controller through the supervised link.

    ``rate_hz``: states per second; the controller divides its own rate.
    ``block_s``: time that one reading covers.
    ``timeout_s``: how long to wait for the controller, and for a state.
    """

    name = _GROUP

    def __init__(self, host: str, rate_hz: float = 125.0, *, block_s: float = 0.2, timeout_s: float = 5.0) -> None:
        self.host, self._rate_hz, self._timeout_s = host, rate_hz, timeout_s
        self._block_n = max(1, round(block_s * rate_hz))
        self._link: UrLink | None = None
        self._last_s: float | None = None
        self._kept: Floats | None = None
        self._running = False
        self._said: tuple[Finding, ...] | None = None

    def open(self) -> None:
        """Connect; see ``UrLink``."""
        if self._link is None:
            self._link = UrLink(
                self.host, self._rate_hz, connect_timeout_s=self._timeout_s, realtime=False, writes=False
            )

    def describe(self) -> Description:
        """Return the recorded part of a state."""
        return Description(_GROUP, self._rate_hz, _COLUMNS, {"host": self.host})

    def check(self) -> tuple[Finding, ...]:
        """Return whether the controller was stopped or ran slower than programmed when this was first asked: at the end it may have done its part."""
        if self._said is not None:
            return self._said
        state = self._next_state()
        findings = []
        if state[layout.RUNTIME_RUNNING] != layout.RUNNING:
            text = "no program runs on the robot"
            findings.append(Finding("robot.idle", "info", text))
        scaling = float(state[layout.SPEED_SCALING])
        if scaling < 1.0:
            text = f"the speed slider is at {100 * scaling:z.0f} %"
            findings.append(Finding("robot.slow", "warning", text, {"scaling_1": scaling}))
        self._said = tuple(findings)
        return self._said

    def start(self) -> None:
        """Begin with the next state."""
        self._require_link()
        self._last_s, self._kept, self._running = None, None, True

    def read(self) -> Reading:
        """Return successive states, up to the first loss."""
        if not self._running:
            raise DeviceError("recording was not started", code="robot.stopped", where=self.host)
        rows: list[Floats] = []
        lost = 0
        until_s = time.monotonic() + self._block_n / self._rate_hz
        while len(rows) < self._block_n and (not rows or time.monotonic() < until_s):
            state = self._kept if self._kept is not None else self._next_state().copy()
            self._kept = None
            missing = self._missing(float(state[layout.TIMESTAMP]))
            if missing is None:
                continue
            if missing and rows:
                self._kept = state
                break
            lost += missing
            self._last_s = float(state[layout.TIMESTAMP])
            rows.append(state)
        table = np.array(rows)
        columns = {n: table[:, layout.INDEX[n]].astype(kind) for n, kind in _COLUMNS.items()}
        return Reading(columns, lost, _LOST_STATES if lost else "")

    def stop(self) -> None:
        """End recording; the link stays."""
        self._running, self._kept = False, None

    def close(self) -> None:
        """End the link; safe to call twice."""
        self.stop()
        link, self._link = self._link, None
        if link is not None:
            link.close()

    def _missing(self, stamp_s: float) -> int | None:
        """Return how many states are missing before this one; None for one that came twice."""
        if self._last_s is None:
            return 0
        steps = round((stamp_s - self._last_s) * self._rate_hz)
        if steps < 0:
            raise DeviceError(
                "the controller's clock has run back: it was restarted",
                code="robot.clock",
                where=self.host,
                got=f"{stamp_s:g} s after {self._last_s:g} s",
                hint="end this recording and begin another",
            )
        return steps - 1 if steps else None

    def _next_state(self) -> Floats:
        state = self._require_link().wait_state(self._timeout_s)
        if state is None:
            raise DeviceError(
                f"the controller sent no state within {self._timeout_s:g} s",
                code="robot.silent",
                where=self.host,
                hint="check whether the controller is overloaded or paused",
            )
        return state

    def _require_link(self) -> UrLink:
        if self._link is None:
            raise DeviceError("the robot is not connected", code="robot.closed", where=self.host)
        return self._link
