"""Numbered, checksummed frames on a byte stream that may lose and invent bytes.

A frame is version, sequence number (16 bit), payload and CRC-16, byte-stuffed (COBS: Cheshire
and Baker, IEEE/ACM Trans. Networking 7, 1999) so that a zero byte ends every frame and occurs
nowhere else: after any garbage the next zero is the start of the next frame.
"""

from __future__ import annotations

import binascii
import struct
from dataclasses import dataclass

from dtwin.errors import InputError

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


def encode(sequence: int, payload: bytes) -> bytes:
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


class FrameReader:
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
