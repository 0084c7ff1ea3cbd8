"""The serial link over pseudo-terminals, with the real pyserial."""

from __future__ import annotations

import math
import os
import random
from collections.abc import Iterator
from pathlib import Path

import pytest
from serial_peer import SerialPeer, serial_peer

from dtwin.acquire import run_recording
from dtwin.acquire._serial_port import SerialInstrument
from dtwin.acquire.run_recording import RunRequest, record_run
from dtwin.errors import DeviceError, InputError
from dtwin.links.serial_line import SerialLink, _FrameReader

COLUMNS = ("force_n", "temperature_c")


@pytest.fixture
def peer() -> Iterator[SerialPeer]:
    with serial_peer() as running:
        yield running


@pytest.fixture
def device(peer: SerialPeer) -> Iterator[SerialInstrument]:
    with SerialInstrument(peer.port, COLUMNS, 200.0, timeout_s=0.4) as opened:
        opened.start()
        yield opened


def code_of(device: SerialInstrument) -> str:
    with pytest.raises(DeviceError) as caught:
        values(device, 1000)
    return caught.value.code


def values(device: SerialInstrument, n: int) -> list[float]:
    got: list[float] = []
    while len(got) < n:
        got += device.read().columns["force_n"].tolist()
    return got


def test_samples_arrive_in_order(peer: SerialPeer, device: SerialInstrument) -> None:
    for k in range(50):
        peer.send(float(k), 20.0, sequence=k)
    assert values(device, 50) == list(range(50))
    assert device.check() == ()


def test_garbage_and_half_frames_are_counted_and_never_values(peer: SerialPeer, device: SerialInstrument) -> None:
    peer.raw(random.Random(5).randbytes(100).replace(b"\x00", b"\x01") + b"\x00")
    peer.send(1.0, 20.0, sequence=0)
    peer.raw(b"\x07half")
    peer.raw(b"\x00")
    peer.send(2.0, 20.0, sequence=1)
    assert values(device, 2) == [1.0, 2.0]
    (finding,) = device.check()
    assert finding.code == "serial.garbage"
    assert finding.numbers["bad_frames"] == 2


def test_what_is_no_finite_number_is_nothing_that_was_read(peer: SerialPeer, device: SerialInstrument) -> None:
    for k, force in enumerate((1.0, math.inf, -math.inf, math.nan, 2.0)):
        peer.send(force, 20.0, sequence=k)
    assert values(device, 5) == pytest.approx([1.0, math.nan, math.nan, math.nan, 2.0], nan_ok=True)
    (finding,) = device.check()
    assert (finding.code, finding.numbers["values_1"]) == ("serial.not_finite", 3)


def test_what_came_during_a_recording_is_told_with_it(
    peer: SerialPeer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_recording, "was_set", lambda told: False)
    peer.stream(2, 400.0)
    taken = iter(range(10**6))

    def stop() -> bool:
        peer.raw(b"\x07half\x00")
        return next(taken) > 1

    request = RunRequest(tmp_path, "c", "m", "r1", None, "r1.csv")
    done = record_run([SerialInstrument(peer.port, COLUMNS, 200.0)], request, stop)
    assert [finding.code for finding in done.findings] == ["serial.garbage"]
    # Of a clock that was never set it is not known when that was.
    assert "started" not in (tmp_path / "campaign.toml").read_text("utf-8")


def test_only_garbage_is_silence(peer: SerialPeer, device: SerialInstrument) -> None:
    peer.raw(b"hello\r\n" * 20)
    assert code_of(device) == "serial.silent"


def test_lost_frames_are_a_gap_before_the_sample_that_follows(peer: SerialPeer, device: SerialInstrument) -> None:
    for k in (0, 1, 5, 6):
        peer.send(float(k), 20.0, sequence=k)
    readings = []
    while sum(r.n_samples for r in readings) < 4:
        readings.append(device.read())
    assert sum(r.lost for r in readings) == 3
    after = next(r for r in readings if r.lost)
    assert after.columns["force_n"][0] == 5.0


def test_the_sequence_number_may_wrap(peer: SerialPeer, device: SerialInstrument) -> None:
    for k in (65534, 65535, 0, 1):
        peer.send(float(k), 20.0, sequence=k)
    got, lost = [], 0
    while len(got) < 4:
        reading = device.read()
        got += reading.columns["force_n"].tolist()
        lost += reading.lost
    assert (got, lost) == ([65534.0, 65535.0, 0.0, 1.0], 0)


def test_a_repeated_frame_is_dropped_and_a_restart_is_said(peer: SerialPeer, device: SerialInstrument) -> None:
    for k in (100, 100, 101):
        peer.send(float(k), 20.0, sequence=k)
    assert values(device, 2) == [100.0, 101.0]
    for k in (0, 1, 2):
        peer.send(float(k), 20.0, sequence=k)
    assert code_of(device) == "serial.restarted"


def test_a_device_that_is_unplugged_is_said(peer: SerialPeer, device: SerialInstrument) -> None:
    peer.send(1.0, 20.0, sequence=0)
    device.read()
    peer.hang_up()
    assert code_of(device) == "serial.lost"
    device.close()
    device.close()


def test_frames_go_out_numbered(peer: SerialPeer) -> None:
    with SerialLink(peer.port, 8) as link:
        assert [link.send(b"abc"), link.send(b"\x00de")] == [0, 1]
        frames = []
        reader = _FrameReader(3)
        while len(frames) < 2:
            frames += reader.feed(os.read(peer.master, 100))
        assert [(f.sequence, f.payload) for f in frames] == [(0, b"abc"), (1, b"\x00de")]


def fill(link: SerialLink) -> None:
    for _ in range(1000):
        link.send(b"x" * 1024)


def test_a_device_that_takes_nothing_is_said(peer: SerialPeer) -> None:
    with SerialLink(peer.port, 8, timeout_s=0.2) as link:
        with pytest.raises(DeviceError) as caught:
            fill(link)
        assert caught.value.code == "serial.stuck"


def test_an_absent_port_names_those_that_are_here(tmp_path: Path) -> None:
    with pytest.raises(DeviceError) as caught:
        SerialLink(str(tmp_path / "ttyX"), 8).open()
    assert caught.value.code == "serial.absent"
    assert "ports that are here" in (caught.value.hint or "")


def test_a_port_serves_one_program(peer: SerialPeer) -> None:
    with SerialLink(peer.port, 8):
        with pytest.raises(DeviceError) as caught:
            SerialLink(peer.port, 8).open()
        assert caught.value.code == "serial.busy"


def test_columns_need_units_and_ports_need_opening(peer: SerialPeer) -> None:
    with pytest.raises(InputError):
        SerialInstrument(peer.port, ("force",), 200.0)
    with pytest.raises(DeviceError) as caught:
        SerialInstrument(peer.port, COLUMNS, 200.0).read()
    assert caught.value.code == "serial.closed"
