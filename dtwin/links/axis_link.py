"""Live offsets of machine axes: states from a control's bridge, corrections back to it.

Both are lines of JSON over one TCP connection; the reference page "Axis link" describes them. A control
on the machine clock waits for the correction of each state before it goes on.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from dtwin.errors import DeviceError, InputError
from dtwin.links import layout
from dtwin.links._line_socket import LineSocket, StateLines
from dtwin.links.layout import Floats, LiveValues
from dtwin.links.virtual_key import new_nonce
from dtwin.units import is_number

PROTOCOL = 1
_STATE_NAMES = ("timestamp_s", "runtime_running", "safety_ok")
"""What every state must have."""

LONGEST_LINE = 65_536
# No line is written and read in less; a rate beyond it would be no number.
_SHORTEST_S = 1e-5
_GREETING_S = 5.0
# A control on the machine clock may think for long between two states.
_LAPSED_S = 30.0
_AXES = ("x", "y", "z")
Clock = Literal["wall", "machine"]
_Samples = Callable[[Floats], None]


@dataclass(frozen=True)
class Greeting:
    """What a control says of itself.

    Attributes:
        period_s: From state to state.
        clock: On the machine clock a state waits for its correction. One of "wall", "machine".
        watchdog_s: Silence after which the control goes back to zero by itself.
        axes: Axes that take an offset.
        proof: Answer to the nonce; see :mod:`dtwin.links.virtual_key`.
    """

    control: str
    period_s: float
    clock: Clock
    watchdog_s: float
    axes: tuple[str, ...]
    proof: str


class AxisLink(StateLines):
    """What the serving loop needs, over one connection to a control's bridge.

    Args:
        address: ``HOST:PORT`` of the bridge.
        live: The inputs that the control must provide.
        axes: Axes that will be corrected.
        channels: Signals that it must sample, at one rate.
        samples: Takes each sample of the channels, shape (channels,).
        writes: Whether corrections may be sent; on the machine clock zeros go out without.

    Attributes:
        greeting: What the control said when the link was opened.
        finished (bool): Whether the control said that its program has ended.
    """

    realtime = False
    greeting: Greeting

    def __init__(
        self,
        address: str,
        live: LiveValues,
        axes: Sequence[str],
        *,
        channels: Sequence[str] = (),
        channels_hz: float = 0.0,
        samples: _Samples | None = None,
        writes: bool = True,
    ) -> None:
        super().__init__(LineSocket(address, "axis link", LONGEST_LINE))
        self.host = self._line.host
        self._live, self._axes, self._writes = live, tuple(axes), writes
        self._channels, self._channels_hz, self._samples = tuple(channels), channels_hz, samples
        self._sample = np.zeros(len(self._channels))
        self.nonce = new_nonce()
        self.finished = False
        self._waiting: list[bytes] = []

    def open(self) -> None:
        """Connect, and agree on what is exchanged.

        Raises ``DeviceError`` when nobody answers, or what answers is no axis link.
        Raises ``InputError`` when the control does not provide what the model needs.
        """
        self._line.open()
        try:
            self._agree()
        except BaseException:
            self._line.close()
            raise
        self._live.forget()
        self._heard_s = time.monotonic()

    def begin(self) -> None:
        """Nothing to do: the control takes corrections as they come."""

    def send(self, offset_um: Floats, sequence: int) -> None:
        """Send a correction (3,) with its number; without the right to write, zeros without a number.

        Raises ``DeviceError`` when the connection ended, or the control does not read.
        """
        if not self._writes:
            offset_um, sequence = np.zeros(3), 0
        x, y, z = offset_um.tolist()
        self._line.send(b'{"sequence":%d,"offset_um":[%r,%r,%r]}\n' % (sequence, x, y, z))

    def _lines(self, until_s: float) -> list[bytes]:
        lines, self._waiting = self._waiting, []
        return lines or super()._lines(until_s)

    def _take(self, lines: list[bytes]) -> bool:
        # Every line counts: values and samples of one that is not the last must not be lost.
        return any([self._read(line) for line in lines])

    def _agree(self) -> None:
        asked = {
            "dtwin": PROTOCOL,
            "inputs": list(self._live.names),
            "axes": list(self._axes),
            "channels": list(self._channels),
            "channels_hz": self._channels_hz,
            "nonce": self.nonce,
        }
        self._line.send(json.dumps(asked).encode() + b"\n")
        lines = self._line.lines(time.monotonic() + _GREETING_S)
        if not lines:
            raise self._line.fault("axes.silent", "what answers does not greet")
        self._waiting = lines[1:]
        told = _object(lines[0])
        if told is None or (told.get("dtwin") != PROTOCOL and "refused" not in told):
            line = lines[0][:80].decode(errors="replace")
            raise self._line.fault("axes.protocol", "what answers is no axis link of this version", line)
        if told.get("refused"):
            raise DeviceError(
                "the control refuses", code="axes.refused", where=self._line.address, got=str(told["refused"])[:200]
            )
        self.greeting = self._greeting(told)
        if self.greeting.clock == "machine":
            self._lost_after_s = max(self._lost_after_s, _LAPSED_S)
        lacking = told.get("missing")
        missing = list(lacking) if isinstance(lacking, list) else []
        missing += [axis for axis in self._axes if axis not in self.greeting.axes]
        if missing:
            raise InputError(
                "the control does not provide what the model needs",
                code="axes.missing",
                where=f"{self.greeting.control} at {self._line.address}",
                got=f"without {', '.join(str(name) for name in missing)}"[:200],
                hint="another machine's control, or another machine's model?",
            )

    def _unusable(self, got: str) -> DeviceError:
        return self._line.fault("axes.greeting", "the control's greeting cannot be used", got[:80])

    def _greeting(self, told: Mapping[str, object]) -> Greeting:
        period, watchdog, clock = (told.get(n) for n in ("period_s", "watchdog_s", "clock"))
        axes = told.get("axes")
        if not (is_number(period) and _SHORTEST_S <= period <= 60.0):
            raise self._unusable(f"period_s {period}")
        if not (is_number(watchdog) and 0.0 < watchdog <= 60.0):
            raise self._unusable(f"watchdog_s {watchdog}")
        if clock not in ("wall", "machine"):
            raise self._unusable(f"clock {clock}")
        if not (isinstance(axes, list) and all(axis in _AXES for axis in axes)):
            raise self._unusable(f"axes {axes}")
        return Greeting(
            str(told.get("control"))[:80],
            float(period),
            "wall" if clock == "wall" else "machine",
            float(watchdog),
            tuple(axes),
            str(told.get("proof", ""))[:128],
        )

    def _read(self, line: bytes) -> bool:
        """Take a line; tell whether it was a state."""
        given = _object(line) or {}
        finite = {name: number for name, v in given.items() if (number := _number(v)) is not None}
        if not all(name in finite for name in _STATE_NAMES):
            return False
        self.finished = self.finished or finite.get("finished", 0.0) > 0.5
        for name, value in finite.items():
            place = layout.INDEX.get(name)
            if place is not None:
                self._state[place] = value
        self._live.take(finite, finite["timestamp_s"])
        if self._samples is not None and all(name in finite for name in self._channels):
            self._sample[:] = [finite[name] for name in self._channels]
            self._samples(self._sample)
        return True


def _object(line: bytes) -> dict[str, object] | None:
    try:
        document = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return document if isinstance(document, dict) else None


def _number(value: object) -> float | None:
    """Return a finite number as it is, anything else as none."""
    if not isinstance(value, int | float):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None
