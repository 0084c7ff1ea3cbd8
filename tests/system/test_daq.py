"""Acquisition with the real nidaqmx client against a loopback server of our own."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from virtual_daq import VirtualDaq, virtual_daq

from dtwin.acquire._daq import AccelerometerChannel, AccelerometerTask
from dtwin.acquire._recording import Recorder
from dtwin.acquire._recovery import seal
from dtwin.acquire.instrument import record
from dtwin.acquire.signal_files import read_signals, write_signals
from dtwin.errors import EXIT_DEVICE, DeviceError
from dtwin.schema import SignalGroup
from studies.machines._daq_sensors import Sensors

pytestmark = pytest.mark.system

CHANNELS = tuple(
    AccelerometerChannel(f"{place}_{axis}_g", f"cDAQ1Mod{module}/ai{number}")
    for module, place in ((1, "wrist"), (2, "base"))
    for number, axis in enumerate("xyz")
)
PHYSICAL = tuple(f"cDAQ1Mod{m}/ai{n}" for m in (1, 2) for n in range(4))
RATE_HZ = 5120.0
STEP_G = 10.0 / 2**24


@pytest.fixture(scope="module")
def shared() -> Iterator[VirtualDaq]:
    with virtual_daq() as running:
        yield running


@pytest.fixture
def daq() -> Iterator[VirtualDaq]:
    with virtual_daq() as running:
        yield running


def task(
    daq: VirtualDaq, rate_hz: float = RATE_HZ, channels: tuple[AccelerometerChannel, ...] = CHANNELS
) -> AccelerometerTask:
    return AccelerometerTask(channels, rate_hz, block_s=0.05, grpc_target=daq.target, timeout_s=1.0)


def true_g(channel: AccelerometerChannel, first: int, n: int, rate_hz: float) -> np.ndarray:
    return Sensors(PHYSICAL).felt_g(channel.physical, first, n, rate_hz)


def started(daq: VirtualDaq) -> AccelerometerTask:
    opened = task(daq)
    opened.open()
    opened.start()
    return opened


def test_blocks_are_every_sample_in_order_in_g(shared: VirtualDaq) -> None:
    with task(shared) as daq:
        assert daq.check() == ()
        daq.start()
        blocks = []
        for _ in range(6):
            block, lost = daq.read_block()
            assert lost == 0
            blocks.append(block.copy())
    got = np.hstack(blocks)
    assert got.shape == (6, 6 * 256)
    for row, channel in zip(got, CHANNELS, strict=True):
        truth = true_g(channel, 0, got.shape[1], RATE_HZ)
        assert np.abs(row - truth).max() <= STEP_G


def test_newest_window_is_the_end_of_what_was_read(shared: VirtualDaq) -> None:
    with task(shared) as daq:
        daq.start()
        assert daq.newest_window(300)[0] is None
        for _ in range(4):
            daq.read_block()
        window, age_s = daq.newest_window(300)
        assert window is not None
        assert window.shape == (6, 300)
        assert 0 <= age_s < 5.0
        truth = true_g(CHANNELS[4], 4 * 256 - 300, 300, RATE_HZ)
        assert np.abs(window[4] - truth).max() <= STEP_G


def test_the_sensitivity_is_used(shared: VirtualDaq) -> None:
    doubled = AccelerometerChannel("wrist_x_g", "cDAQ1Mod1/ai0", sensitivity_mv_g=500.0)
    with task(shared, channels=(doubled,)) as daq:
        daq.start()
        block, _ = daq.read_block()
    truth = true_g(doubled, 0, block.shape[1], RATE_HZ)
    assert np.abs(block[0] - 2 * truth).max() <= 2 * STEP_G


def test_another_rate_than_the_modules_is_reported_and_kept(shared: VirtualDaq, tmp_path: Path) -> None:
    with task(shared, 25_000.0) as daq:
        (finding,) = daq.check()
        assert finding.code == "daq.rate_coerced"
        assert daq.rate_hz == 25_600.0
        described = daq.describe()
        stream = tmp_path / "r1.arrows"
        with Recorder(stream, described.group, described.rate_hz, described.columns, notes=described.notes) as recorder:
            daq.start()
            record(daq, recorder, lambda n: n < 5000)
    seal(stream, tmp_path / "r1.parquet")
    (group,) = read_signals(tmp_path / "r1.parquet")
    assert group.rate_hz == 25_600.0
    truth = true_g(CHANNELS[0], 0, group.n_samples, 25_600.0)
    assert np.abs(group.columns["wrist_x_g"] - truth).max() < 1e-6


def test_an_overrun_is_a_counted_gap_never_bridged(daq: VirtualDaq, tmp_path: Path) -> None:
    reading = started(daq)
    described = reading.describe()
    stream = tmp_path / "r1.arrows"
    with Recorder(stream, described.group, described.rate_hz, described.columns) as recorder:
        record(reading, recorder, lambda n: n < 512)
        daq.do("overrun", samples=1234)
        record(reading, recorder, lambda n: n < 12_000)
        assert reading.newest_window(5000)[0] is None
        record(reading, recorder, lambda n: n < 17_000)
    reading.close()
    sealed = seal(stream, tmp_path / "r1.parquet")
    assert [f.code for f in sealed.findings] == ["recording.gap"]
    (group,) = read_signals(tmp_path / "r1.parquet")
    lost = np.isnan(group.columns["base_z_g"])
    assert 10_000 < lost.sum() < 17_000
    for channel in CHANNELS:
        truth = true_g(channel, 0, group.n_samples, RATE_HZ)
        assert np.abs(group.columns[channel.name] - truth)[~lost].max() < 1e-6


def test_a_removed_module_is_said_and_the_task_still_closes(daq: VirtualDaq) -> None:
    reading = started(daq)
    reading.read_block()
    daq.do("remove", device="cDAQ1Mod2")

    def read_on() -> None:
        for _ in range(100):
            reading.read_block()

    with pytest.raises(DeviceError) as caught:
        read_on()
    assert caught.value.code == "daq.removed"
    assert caught.value.exit_code == EXIT_DEVICE
    reading.stop()
    reading.close()
    reading.close()
    daq.do("restore")
    again = started(daq)
    again.read_block()
    again.close()


def test_no_samples_in_time_is_said(daq: VirtualDaq) -> None:
    reading = started(daq)
    daq.do("silence", seconds=60)
    with pytest.raises(DeviceError) as caught:
        reading.read_block()
    assert caught.value.code == "daq.silent"
    reading.close()


def test_a_server_that_freezes_is_said(daq: VirtualDaq) -> None:
    reading = started(daq)
    reading.read_block()
    daq.process.send_signal(signal.SIGSTOP)
    with pytest.raises(DeviceError) as caught:
        reading.read_block()
    reading.close()
    daq.process.send_signal(signal.SIGCONT)
    assert caught.value.code == "daq.server_lost"


def test_a_server_that_dies_is_said(daq: VirtualDaq) -> None:
    reading = started(daq)
    reading.read_block()
    daq.process.kill()
    daq.process.wait()
    with pytest.raises(DeviceError) as caught:
        reading.read_block()
    assert caught.value.code == "daq.server_lost"
    reading.close()


def test_swapped_channels_are_refused(daq: VirtualDaq) -> None:
    daq.do("swap")
    with pytest.raises(DeviceError) as caught:
        task(daq).open()
    assert caught.value.code == "daq.channel_order"


@pytest.mark.parametrize(
    ("physical", "code"), [("cDAQ9Mod1/ai0", "daq.device_absent"), ("cDAQ1Mod1/ai7", "daq.channel_absent")]
)
def test_absent_modules_and_inputs_are_named(shared: VirtualDaq, physical: str, code: str) -> None:
    wrong = task(shared, channels=(AccelerometerChannel("wrist_x_g", physical),))
    with pytest.raises(DeviceError) as caught:
        wrong.open()
    assert caught.value.code == code
    assert shared.target in caught.value.render()


def test_two_tasks_on_one_module_are_refused(shared: VirtualDaq) -> None:
    with task(shared) as first, task(shared) as second:
        first.start()
        with pytest.raises(DeviceError) as caught:
            second.start()
        assert caught.value.code == "daq.busy"


def test_a_given_recording_is_played(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    columns = {c.name: rng.normal(0, 0.1, 4000).astype(np.float32) for c in CHANNELS}
    path = tmp_path / "played.parquet"
    write_signals(path, SignalGroup("accelerometers", RATE_HZ, columns))
    with virtual_daq(f"--signals={path}") as peer, task(peer) as daq:
        daq.start()
        block, _ = daq.read_block()
        for row, channel in zip(block, CHANNELS, strict=True):
            assert np.abs(row - columns[channel.name][:256]).max() <= STEP_G


def test_samples_come_at_the_modules_pace(shared: VirtualDaq) -> None:
    with task(shared) as daq:
        daq.start()
        begun_s = time.monotonic()
        for _ in range(10):
            daq.read_block()
        # Never faster than the module samples; how much slower is the host's affair.
        assert time.monotonic() - begun_s >= 9.5 * 0.05
