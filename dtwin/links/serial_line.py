"""A serial line to one device: numbered frames, and never a value from garbage."""

from __future__ import annotations

import contextlib
import errno
import time
from collections.abc import Iterator
from typing import Any

from dtwin.errors import DeviceError, MissingPart
from dtwin.links.frames import SEQUENCES, Frame, FrameReader, encode
from dtwin.links.opened import OpenAndClose


class SerialLink(OpenAndClose):
    """Frames to and from one device.

    ``port``: such as ``"/dev/ttyACM0"``.
    ``payload_size``: bytes of payload of every frame that the device sends.
    ``baud``: bits per second; means nothing on a pseudo-terminal or a USB-CDC device.
    ``timeout_s``: silence after which the device counts as gone; longest time of a write.
    """

    def __init__(self, port: str, payload_size: int, *, baud: int = 115_200, timeout_s: float = 1.0) -> None:
        self.port, self.timeout_s = port, timeout_s
        self._baud, self._payload_size = baud, payload_size
        self._device: Any = None
        self._reader = FrameReader(payload_size)
        self._sequence = 0

    @property
    def bad_frames(self) -> int:
        """Pieces of garbage that were thrown away since opening."""
        return self._reader.bad_frames

    def open(self) -> None:
        """Open the port for this process alone.

        Raises ``MissingPart`` when pyserial is not installed.
        Raises ``DeviceError`` when the port is absent, forbidden or in use.
        """
        if self._device is not None:
            return
        try:
            import serial
        except ImportError as error:
            raise MissingPart(
                "the package pyserial is not installed",
                code="serial.package",
                hint="pip install '.[serve]' in a checkout of dtwin",
            ) from error
        try:
            self._device = serial.Serial(
                self.port, self._baud, timeout=self.timeout_s, write_timeout=self.timeout_s, exclusive=True
            )
        except (OSError, ValueError) as error:
            raise self._open_error(error) from error
        self._reader = FrameReader(self._payload_size)
        self._sequence = 0

    def send(self, payload: bytes) -> int:
        """Send a frame and return its sequence number.

        Raises ``DeviceError`` when the device does not take it in time or is gone.
        """
        sequence = self._sequence
        data = encode(sequence, payload)
        with self._faults():
            self._device.write(data)
        self._sequence = (sequence + 1) % SEQUENCES
        return sequence

    def receive(self) -> list[Frame]:
        """Return the frames that have arrived, waiting for at least one.

        Raises ``DeviceError`` when no whole frame arrives in time, or the device is gone.
        """
        until_s = time.monotonic() + self.timeout_s
        while True:
            with self._faults():
                data = self._device.read(max(1, self._device.in_waiting))
            frames = self._reader.feed(data)
            if frames:
                return frames
            if time.monotonic() > until_s:
                raise DeviceError(
                    f"no whole frame within {self.timeout_s:g} s",
                    code="serial.silent",
                    where=self.port,
                    got=f"{self.bad_frames} pieces of garbage since opening",
                    hint="check baud rate, cable and the device's firmware",
                )

    def arrived(self) -> list[Frame]:
        """Return the frames that have arrived, without waiting. Raises ``DeviceError`` when the device is gone."""
        with self._faults():
            waiting = self._device.in_waiting
            return self._reader.feed(self._device.read(waiting)) if waiting else []

    def discard(self) -> None:
        """Forget what has arrived and was not received."""
        with self._faults():
            self._device.reset_input_buffer()
        bad = self._reader.bad_frames
        self._reader = FrameReader(self._payload_size)
        self._reader.bad_frames = bad

    def close(self) -> None:
        """Release the port; safe to call twice."""
        device, self._device = self._device, None
        if device is not None:
            with contextlib.suppress(OSError):
                device.close()

    @contextlib.contextmanager
    def _faults(self) -> Iterator[None]:
        if self._device is None:
            raise DeviceError("the port is not open", code="serial.closed", where=self.port)
        from serial import SerialTimeoutException

        try:
            yield
        except SerialTimeoutException as error:
            raise DeviceError(
                f"the serial device took nothing for {self.timeout_s:g} s",
                code="serial.stuck",
                where=self.port,
                hint="check flow control and the device's firmware",
            ) from error
        except OSError as error:
            raise DeviceError(
                "the serial device is gone",
                code="serial.lost",
                where=self.port,
                got=str(error)[:200],
                hint="plug it in again and start again; its name may have changed",
            ) from error

    def _open_error(self, error: OSError | ValueError) -> DeviceError:
        number = getattr(error, "errno", None)
        if number in (errno.EAGAIN, errno.EBUSY):
            code, text, hint = "serial.busy", "another program uses the port", "end that program"
        elif number == errno.EACCES:
            code, text = "serial.forbidden", "this user may not open the port"
            hint = "add the user to the group dialout and log in again"
        else:
            code, text = "serial.absent", "there is no such serial port"
            hint = f"ports that are here: {', '.join(_ports()) or 'none'}"
        return DeviceError(text, code=code, where=self.port, got=str(error)[:200], hint=hint)


def _ports() -> list[str]:
    from serial.tools import list_ports

    return [port.device for port in list_ports.comports()][:10]
