"""A serial line to one device: numbered frames, and never a value from garbage.

A frame is version, sequence number (16 bit), payload and CRC-16, byte-stuffed (COBS: Cheshire
and Baker, IEEE/ACM Trans. Networking 7, 1999) so that a zero byte ends every frame and occurs
nowhere else: after any garbage the next zero is the start of the next frame.
"""

from __future__ import annotations

import binascii
import contextlib
import errno
import struct
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from dtwin.errors import DeviceError, InputError, MissingPart
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
        self._reader = _FrameReader(payload_size)
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
        self._reader = _FrameReader(self._payload_size)
        self._sequence = 0

    def send(self, payload: bytes) -> int:
        """Send a frame and return its sequence number.

        Raises ``DeviceError`` when the device does not take it in time or is gone.
        """
        sequence = self._sequence
        data = _encode(sequence, payload)
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
        self._reader = _FrameReader(self._payload_size)
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


_VERSION = 1
SEQUENCES = 1 << 16
_MAX_PAYLOAD = 1024

_HEAD = struct.Struct("<BH")
_CRC = struct.Struct("<H")


@dataclass(frozen=True)
class Frame:
    """A frame that arrived whole. ``sequence``: 0 to 65535, counted by the sender."""

    sequence: int
    payload: bytes


def _crc16(data: bytes) -> int:
    """Return the CRC-16/CCITT-FALSE (polynomial 0x1021, start 0xFFFF) of some bytes."""
    return binascii.crc_hqx(data, 0xFFFF)


def _encode(sequence: int, payload: bytes) -> bytes:
    """Return a frame as it goes over the line, its end mark included.

    ``sequence``: 0 to 65535.
    ``payload``: at most ``_MAX_PAYLOAD`` bytes.
    """
    if not 0 <= sequence < SEQUENCES or len(payload) > _MAX_PAYLOAD:
        raise InputError(
            "this does not fit a frame",
            code="serial.frame",
            got=f"sequence {sequence}, {len(payload)} bytes",
            allowed=f"sequence below {SEQUENCES}, at most {_MAX_PAYLOAD} bytes",
        )
    body = _HEAD.pack(_VERSION, sequence) + payload
    return _stuffed(body + _CRC.pack(_crc16(body))) + b"\x00"


class _FrameReader:
    """Finds frames in what arrives, in pieces of any size.

    ``payload_size``: size that every payload must have; a frame of another size is garbage.
    ``bad_frames``: pieces between end marks that were no frame of ours.
    """

    def __init__(self, payload_size: int) -> None:
        self._frame_size = _HEAD.size + payload_size + _CRC.size
        self._longest = len(_stuffed(bytes([1]) * self._frame_size))
        self._pending = bytearray()
        self._overlong = False
        self.bad_frames = 0

    def feed(self, data: bytes) -> list[Frame]:
        """Return the frames that these bytes complete."""
        frames = []
        *pieces, rest = data.split(b"\x00")
        for piece in pieces:
            self._collect(piece)
            frame = self._take()
            if frame is not None:
                frames.append(frame)
        self._collect(rest)
        return frames

    def _collect(self, piece: bytes) -> None:
        """Keep bytes of the frame in the making, but never more than a frame can have."""
        if len(self._pending) + len(piece) > self._longest:
            self._overlong = True
            self._pending.clear()
        elif not self._overlong:
            self._pending += piece

    def _take(self) -> Frame | None:
        stuffed, overlong = bytes(self._pending), self._overlong
        self._pending.clear()
        self._overlong = False
        if not stuffed and not overlong:
            return None
        frame = None if overlong else self._frame(stuffed)
        self.bad_frames += frame is None
        return frame

    def _frame(self, stuffed: bytes) -> Frame | None:
        body = _unstuffed(stuffed)
        if body is None or len(body) != self._frame_size:
            return None
        content, (crc,) = body[: -_CRC.size], _CRC.unpack(body[-_CRC.size :])
        version, sequence = _HEAD.unpack_from(content)
        if crc != _crc16(content) or version != _VERSION:
            return None
        return Frame(sequence, content[_HEAD.size :])


def _stuffed(body: bytes) -> bytes:
    out = bytearray()
    for run in body.split(b"\x00"):
        while len(run) >= 254:
            out += b"\xff" + run[:254]
            run = run[254:]
        out += bytes([len(run) + 1]) + run
    return bytes(out)


def _unstuffed(stuffed: bytes) -> bytes | None:
    out, at = bytearray(), 0
    while at < len(stuffed):
        length = stuffed[at]
        run = stuffed[at + 1 : at + length]
        if len(run) != length - 1:
            return None
        out += run
        at += length
        if length < 255 and at < len(stuffed):
            out += b"\x00"
    return bytes(out)
