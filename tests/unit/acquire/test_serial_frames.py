"""Frames: whatever happens to the bytes, what comes out was sent."""

from __future__ import annotations

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dtwin.errors import InputError
from dtwin.links.serial_line import _crc16, _encode, _FrameReader

PAYLOAD = 12
payloads = st.binary(min_size=PAYLOAD, max_size=PAYLOAD)


def in_pieces(data: bytes, rng: random.Random) -> list[bytes]:
    pieces = []
    while data:
        n = rng.choice([1, 1, 2, 5, 40, 400])
        pieces.append(data[:n])
        data = data[n:]
    return pieces


def test_crc_has_the_published_check_value() -> None:
    assert _crc16(b"123456789") == 0x29B1


@given(st.lists(payloads, max_size=20), st.randoms(use_true_random=False))
def test_frames_survive_any_cutting(sent: list[bytes], rng: random.Random) -> None:
    reader = _FrameReader(PAYLOAD)
    line = b"".join(_encode(n, payload) for n, payload in enumerate(sent))
    got = [frame for piece in in_pieces(line, rng) for frame in reader.feed(piece)]
    assert [(f.sequence, f.payload) for f in got] == list(enumerate(sent))
    assert reader.bad_frames == 0


@given(st.binary(min_size=0, max_size=700))
def test_any_size_of_payload_round_trips(payload: bytes) -> None:
    data = _encode(7, payload)
    assert data.count(b"\x00") == 1
    (frame,) = _FrameReader(len(payload)).feed(data)
    assert frame.payload == payload


@pytest.mark.parametrize("size", [252, 249, 250, 503, 1024])
def test_the_longest_runs_round_trip(size: int) -> None:
    for filler in (b"\x00", b"\x01", b"\xff"):
        (frame,) = _FrameReader(size).feed(_encode(65535, filler * size))
        assert frame.payload == filler * size


@settings(max_examples=300)
@given(st.lists(st.tuples(payloads, st.binary(max_size=60)), min_size=1, max_size=10))
def test_garbage_costs_at_most_its_neighbour(parts: list[tuple[bytes, bytes]]) -> None:
    reader = _FrameReader(PAYLOAD)
    sent = {}
    line = bytearray()
    for number, (payload, garbage) in enumerate(parts):
        # Garbage may swallow the frame after it, but an end mark before a frame saves it.
        line += garbage + b"\x00" + _encode(number, payload)
        sent[number] = payload
    got = reader.feed(bytes(line))
    assert {f.sequence: f.payload for f in got} == sent


@settings(max_examples=300)
@given(st.lists(payloads, min_size=3, max_size=10), st.integers(min_value=0), st.integers(min_value=1, max_value=255))
def test_a_damaged_byte_never_becomes_a_value(sent: list[bytes], place: int, flip: int) -> None:
    line = bytearray(b"".join(_encode(n, payload) for n, payload in enumerate(sent)))
    line[place % len(line)] ^= flip
    reader = _FrameReader(PAYLOAD)
    got = {f.sequence: f.payload for f in reader.feed(bytes(line) + b"\x00")}
    assert all(sent[n] == payload for n, payload in got.items())
    assert len(sent) - 2 <= len(got) < len(sent)
    assert reader.bad_frames >= 1


def test_endless_garbage_takes_no_memory_and_resyncs() -> None:
    reader = _FrameReader(PAYLOAD)
    for _ in range(1000):
        assert reader.feed(b"\x55" * 1000) == []
    assert len(reader._pending) < 100
    (frame,) = reader.feed(b"\x00" + _encode(3, b"x" * PAYLOAD))
    assert frame.sequence == 3
    assert reader.bad_frames == 1


def test_what_does_not_fit_is_refused() -> None:
    for sequence, payload in ((65536, b""), (-1, b""), (0, b"x" * 1025)):
        with pytest.raises(InputError):
            _encode(sequence, payload)
