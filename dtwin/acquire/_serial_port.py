"""Instruments on a serial line: numbered frames, and never a value from garbage; what is no finite number is none."""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np

from dtwin.acquire.instrument import Description, Reading
from dtwin.errors import DeviceError
from dtwin.links.opened import OpenAndClose
from dtwin.links.serial_line import SEQUENCES, Frame, SerialLink
from dtwin.schema import Finding
from dtwin.units import require_units

_LOST_FRAMES = "frames lost on the serial line"

_LATE_IN_A_ROW = 3


class SerialInstrument(OpenAndClose):
    """A device that sends its samples as frames of 32-bit floats, one frame a sample.

    ``port``: such as ``"/dev/ttyACM0"``.
    ``columns``: what a frame holds, in order; names end in their unit.
    ``rate_hz``: frames per second by the device's clock.
    ``baud``, ``timeout_s``: as for ``SerialLink``.
    """

    def __init__(
        self,
        port: str,
        columns: Sequence[str],
        rate_hz: float,
        *,
        group: str = "serial",
        baud: int = 115_200,
        timeout_s: float = 1.0,
    ) -> None:
        require_units(columns, f"serial device at {port}")
        self.name = group
        self._columns, self._rate_hz = tuple(columns), rate_hz
        self._values = struct.Struct(f"<{len(columns)}f")
        self.link = SerialLink(port, self._values.size, baud=baud, timeout_s=timeout_s)
        self._next: int | None = None
        self._late = 0
        self._kept: list[Frame] = []
        self._not_finite = 0

    def open(self) -> None:
        """Open the port; see ``SerialLink.open``."""
        self.link.open()

    def describe(self) -> Description:
        """Return the columns in single precision."""
        columns = {name: np.dtype(np.float32) for name in self._columns}
        return Description(self.name, self._rate_hz, columns, {"port": self.link.port})

    def check(self) -> tuple[Finding, ...]:
        """Return whether garbage has been seen on the line, or what is no finite number."""
        out = []
        if bad := self.link.bad_frames:
            text = f"{bad} pieces of garbage were thrown away on the serial line"
            out.append(Finding("serial.garbage", "warning", text, {"bad_frames": float(bad)}))
        if none := self._not_finite:
            text = f"the serial device sent {none} values that are no finite numbers: they are kept as nothing that was read"
            out.append(Finding("serial.not_finite", "warning", text, {"values_1": float(none)}))
        return tuple(out)

    def start(self) -> None:
        """Begin with the next frame that arrives."""
        self.link.discard()
        self._next, self._late, self._kept, self._not_finite = None, 0, [], 0

    def read(self) -> Reading:
        """Return the samples that have arrived, up to the first loss, waiting for at least one."""
        lost = 0
        rows: list[tuple[float, ...]] = []
        while not rows:
            frames = self._kept or self.link.receive()
            self._kept = []
            for place, frame in enumerate(frames):
                ahead = self._ahead(frame)
                if ahead is None:
                    continue
                if ahead and rows:
                    self._kept = frames[place:]
                    break
                lost += ahead
                rows.append(self._values.unpack(frame.payload))
                self._next = (frame.sequence + 1) % SEQUENCES
        table = np.array(rows, dtype=np.float32)
        none = ~np.isfinite(table)
        # An infinity would make the whole file of signals one that is not read.
        table[none] = np.nan
        self._not_finite += int(none.sum())
        columns = {n: table[:, place].copy() for place, n in enumerate(self._columns)}
        return Reading(columns, lost, _LOST_FRAMES if lost else "")

    def stop(self) -> None:
        """Keep nothing of what has arrived."""
        self._kept = []

    def close(self) -> None:
        """Release the port; safe to call twice."""
        self.link.close()

    def _ahead(self, frame: Frame) -> int | None:
        """Return how many frames are missing before this one; None for one that is late."""
        ahead = 0 if self._next is None else (frame.sequence - self._next) % SEQUENCES
        if ahead < SEQUENCES // 2:
            self._late = 0
            return ahead
        self._late += 1
        if self._late >= _LATE_IN_A_ROW:
            raise DeviceError(
                "the serial device has started to count anew",
                code="serial.restarted",
                where=self.link.port,
                hint="end this recording and begin another; check the device's power",
            )
        return None
