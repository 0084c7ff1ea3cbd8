"""Corrections as voltages: the host's end of an analogue output with a watchdog of its own.

The control takes a voltage as an offset of its encoders, as an Aerotech A3200 does: 25 um per volt
round 5 V. The board (``firmware/analogue_correction.c``) latches three codes of a whole frame at
once, reads them back from its converter, and goes to its neutral codes by itself when frames stop.
"""

from __future__ import annotations

import struct
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dtwin.errors import DeviceError, InputError
from dtwin.links.opened import OpenAndClose
from dtwin.links.serial_line import Frame, SerialLink

AXES = ("x", "y", "z")
_BAUD = 250_000
FULL_SCALE_V = 10.0
_CODES = 1 << 16
TRAVEL_UM = 125.0
_Output = Literal["dac", "pwm"]
_Floats = NDArray[np.float64]
_Codes = tuple[int, int, int]

_STATUS, _SET, _ENGAGE, _RELEASE, _NEUTRAL = range(5)
_REQUEST = struct.Struct("<B3H")
_ANSWER = struct.Struct("<BB3HHH")
_ENGAGED, _TRIPPED, _PWM, _READ_BACK_WRONG, _NOT_ENGAGED, _STALE, _UNKNOWN = (1 << bit for bit in range(7))
_MODES: dict[_Output, int] = {"dac": 0, "pwm": 1}
# A board of this kind restarts when its port is opened, and its boot loader listens first.
_WAKE_S = 4.0
_TRIES = 3
_PWM_STEPS = 255


@dataclass(frozen=True)
class AxisCalibration:
    """What a voltage does to one axis.

    ``um_per_v``: displacement of the axis per volt; negative when it is wired the other way round.
    ``neutral_v``: voltage that stands for no correction.
    """

    um_per_v: float = 25.0
    neutral_v: float = 5.0

    def code(self, offset_um: float) -> int:
        """Return the converter's code for an offset, kept within travel and range."""
        within = max(-TRAVEL_UM, min(TRAVEL_UM, offset_um))
        volts = self.neutral_v + within / self.um_per_v
        return max(0, min(_CODES - 1, round(volts / FULL_SCALE_V * _CODES)))

    def offset_um(self, code: int) -> float:
        """Return the offset that a code stands for."""
        return (code * FULL_SCALE_V / _CODES - self.neutral_v) * self.um_per_v


@dataclass(frozen=True)
class _Answer:
    """What the board said.

    ``engaged``, ``tripped``, ``pwm``, ``read_back_wrong``: whether it takes corrections; its watchdog dropped them;
    which output is in use; the converter does not hold what was written.
    ``refused``: why the request had no effect; empty when it had.
    ``applied``: codes read back from the converter.
    ``bad_frames``, ``trips``: counted since the board started.
    """

    sequence: int
    engaged: bool
    tripped: bool
    pwm: bool
    read_back_wrong: bool
    refused: str
    applied: _Codes
    bad_frames: int
    trips: int

    @classmethod
    def of(cls, frame: Frame) -> _Answer:
        """Read a frame of the board."""
        _, flags, a, b, c, bad, trips = _ANSWER.unpack(frame.payload)
        refused = {_NOT_ENGAGED: "not engaged", _STALE: "late", _UNKNOWN: "unknown command"}
        return cls(
            frame.sequence,
            bool(flags & _ENGAGED),
            bool(flags & _TRIPPED),
            bool(flags & _PWM),
            bool(flags & _READ_BACK_WRONG),
            next((text for bit, text in refused.items() if flags & bit), ""),
            (a, b, c),
            bad,
            trips,
        )


class AnalogueOutput(OpenAndClose):
    """Three analogue corrections behind a serial port.

    ``port``: such as ``"/dev/ttyACM0"``.
    ``calibration``, length 3: of x, y and z.
    ``output``: the 16-bit converter, or pulse widths of eight bits, whose steps are 0.98 um.
    ``watchdog_ms``: silence after which the board goes neutral by itself, 2 to 1000.
    ``in_flight``: requests that may be unanswered before the next one waits.
    ``timeout_s``: longest silence of the board, unless its watchdog is longer.
    ``sent``, ``answered``, ``clamped``: corrections sent and answered; values that were beyond the travel.
    ``in_force``: number of the newest correction that the board has confirmed; 0 after it went neutral.
    """

    def __init__(
        self,
        port: str,
        calibration: Sequence[AxisCalibration] = (AxisCalibration(),) * 3,
        *,
        output: _Output = "dac",
        watchdog_ms: int = 20,
        in_flight: int = 4,
        timeout_s: float = 0.25,
    ) -> None:
        if len(calibration) != len(AXES) or not 2 <= watchdog_ms <= 1000:
            raise InputError(
                "this is no analogue output",
                code="analogue.settings",
                got=f"{len(calibration)} axes, watchdog {watchdog_ms} ms",
                allowed="3 axes, watchdog 2 to 1000 ms",
            )
        self.calibration = tuple(calibration)
        self.output: _Output = output
        self.watchdog_ms = watchdog_ms
        # A board that is left unfed goes neutral after the watchdog: until then silence is no fault.
        patience_s = max(timeout_s, watchdog_ms / 1000.0)
        self.link = SerialLink(port, _ANSWER.size, baud=_BAUD, timeout_s=patience_s)
        self.sent = self.answered = self.clamped = self.in_force = 0
        self._in_flight = in_flight
        self._waiting: deque[tuple[int, _Codes, int]] = deque()

    @property
    def neutral(self) -> _Codes:
        """Codes that stand for no correction."""
        return self._codes(np.zeros(3))

    def open(self) -> _Answer:
        """Open the port and wait for the board.

        Raises ``DeviceError`` when the port cannot be opened or no board answers.
        """
        self.link.open()
        until_s = time.monotonic() + _WAKE_S
        while True:
            try:
                return self.status()
            except DeviceError as error:
                if error.code != "serial.silent" or time.monotonic() > until_s:
                    self.link.close()
                    raise

    def status(self) -> _Answer:
        """Ask the board how it is; this does not feed its watchdog."""
        return self._ask(_STATUS, (0, 0, 0))

    def engage(self) -> _Answer:
        """Begin to take corrections, from neutral.

        Raises ``DeviceError`` when the converter does not hold its neutral codes.
        """
        self.in_force = 0
        answer = self._ask(_ENGAGE, (_MODES[self.output], self.watchdog_ms, 0))
        self._check(answer, None)
        return answer

    def release(self) -> _Answer:
        """Go neutral and take no more corrections."""
        return self._ask(_RELEASE, (0, 0, 0))

    def store_neutral(self) -> _Answer:
        """Keep this calibration's neutral codes on the board, without power too."""
        return self._ask(_NEUTRAL, self.neutral)

    def send(self, offset_um: _Floats, number: int = 0) -> None:
        """Send a correction; answers to earlier ones are checked as they come.

        ``offset_um``, shape (3,): along x, y and z.
        ``number``: what ``in_force`` is once the board has confirmed it.
        Raises ``DeviceError`` when the board tripped, refused, does not hold what was sent, or is silent.
        """
        if not np.isfinite(offset_um).all():
            raise DeviceError("the correction is not finite", code="analogue.not_finite")
        self.clamped += int((np.abs(offset_um) > TRAVEL_UM).any())
        while len(self._waiting) >= self._in_flight:
            self.settle(self._in_flight - 1)
        codes = self._codes(offset_um)
        self._waiting.append((self.link.send(_REQUEST.pack(_SET, *codes)), codes, number))
        self.sent += 1

    def poll(self) -> None:
        """Check the answers that have arrived, without waiting for any."""
        for frame in self.link.arrived():
            self._take(_Answer.of(frame))

    def settle(self, unanswered: int = 0) -> None:
        """Wait until at most so many corrections are unanswered, and check the answers."""
        while len(self._waiting) > unanswered:
            for frame in self.link.receive():
                self._take(_Answer.of(frame))

    def _take(self, answer: _Answer) -> None:
        """Check the answer to a correction; those before it that were not answered are lost."""
        while self._waiting and self._waiting[0][0] != answer.sequence:
            self._waiting.popleft()
        if self._waiting:
            _, codes, number = self._waiting.popleft()
            self.answered += 1
            self._check(answer, codes)
            self.in_force = number

    def close(self) -> None:
        """Release the port; the board goes neutral by itself."""
        self.link.close()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Go neutral when the board still listens, and release the port."""
        try:
            if not isinstance(error, DeviceError):
                self.release()
        finally:
            self.close()

    def _codes(self, offset_um: _Floats) -> _Codes:
        x, y, z = (axis.code(float(um)) for axis, um in zip(self.calibration, offset_um, strict=True))
        return x, y, z

    def _ask(self, command: int, arguments: _Codes) -> _Answer:
        """Ask until the board answers: a spoilt line loses requests and answers alike."""
        for _ in range(_TRIES - 1):
            try:
                return self._asked(command, arguments)
            except DeviceError as error:
                if error.code != "serial.silent":
                    raise
        return self._asked(command, arguments)

    def _asked(self, command: int, arguments: _Codes) -> _Answer:
        # Not settled first: where the last answers were lost, nothing more would come.
        sequence = self.link.send(_REQUEST.pack(command, *arguments))
        until_s = time.monotonic() + self.link.timeout_s
        while time.monotonic() < until_s:
            for frame in self.link.receive():
                if frame.sequence == sequence:
                    self._waiting.clear()
                    return _Answer.of(frame)
                self._take(_Answer.of(frame))
        raise DeviceError(
            "the board answers other requests than this one",
            code="serial.silent",
            where=self.link.port,
            hint="another program talks to the board",
        )

    def _check(self, answer: _Answer, codes: _Codes | None) -> None:
        where = self.link.port
        if answer.tripped:
            raise DeviceError(
                f"the board's watchdog dropped the correction after {self.watchdog_ms} ms of silence",
                code="analogue.tripped",
                where=where,
                got=f"{answer.trips} trips since it started",
                hint="engage again; a longer watchdog takes slower loops",
            )
        if answer.refused:
            raise DeviceError(
                "the board refused a correction", code="analogue.refused", where=where, got=answer.refused
            )
        wanted = codes if codes is None or self.output == "dac" else _eight_bits(codes)
        if answer.read_back_wrong or (wanted is not None and answer.applied != wanted):
            self._waiting.clear()
            self.link.send(_REQUEST.pack(_RELEASE, 0, 0, 0))
            raise DeviceError(
                "the converter does not hold what was sent",
                code="analogue.read_back",
                where=where,
                got=str(answer.applied),
                allowed=str(wanted),
                hint="check the converter's supply and wiring; the correction was released",
            )


def _eight_bits(codes: _Codes) -> _Codes:
    """Return what is left of codes as pulse widths of eight bits."""
    x, y, z = (min(0xFF, (code + 0x80) >> 8) << 8 for code in codes)
    return x, y, z


def _step_um(calibration: AxisCalibration, output: _Output) -> float:
    """Return the smallest change of the correction that an output can make."""
    steps = _CODES if output == "dac" else _PWM_STEPS
    return abs(calibration.um_per_v) * FULL_SCALE_V / steps
