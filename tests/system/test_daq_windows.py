"""Windows for serving, from a process that reads the real client, against the loopback peer."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from virtual_daq import VirtualDaq, virtual_daq

from dtwin.acquire._daq import AccelerometerChannel
from dtwin.acquire._daq_windows import DaqWindows
from dtwin.errors import DeviceError, InputError
from dtwin.features.windows import WindowContract
from studies.machines._daq_sensors import Sensors

pytestmark = pytest.mark.system

CHANNELS = tuple(AccelerometerChannel(f"wrist_{axis}_g", f"cDAQ1Mod1/ai{n}") for n, axis in enumerate("xyz"))
PHYSICAL = tuple(f"cDAQ1Mod{m}/ai{n}" for m in (1, 2) for n in range(4))
CONTRACT = WindowContract(5120.0, 600, 64, tuple(c.name for c in CHANNELS), ("rms",))


@pytest.fixture
def daq() -> Iterator[VirtualDaq]:
    with virtual_daq() as running:
        yield running


def windows(daq: VirtualDaq, contract: WindowContract = CONTRACT) -> DaqWindows:
    return DaqWindows(contract, CHANNELS, grpc_target=daq.target, timeout_s=1.0)


def wait_for(holds: Callable[[], object], seconds: float = 300.0) -> object:
    until_s = time.monotonic() + seconds
    while time.monotonic() < until_s:
        found = holds()
        if found is not None and found is not False:
            return found
        time.sleep(0.002)
    raise AssertionError("never came true")


def place_of(window: np.ndarray) -> int:
    """Find where the window's end lies on the device's clock, by the truth."""
    truth = Sensors(PHYSICAL).felt_g("cDAQ1Mod1/ai0", 0, 120_000, 5120.0)
    for start in np.flatnonzero(np.abs(truth - window[0, 0]) < 1e-6):
        part = truth[start : start + window.shape[1]]
        if len(part) == window.shape[1] and np.abs(part - window[0]).max() < 1e-6:
            return int(start) + window.shape[1]
    raise AssertionError("the window is not a stretch of the truth")


def test_windows_are_whole_true_and_a_hop_apart(daq: VirtualDaq) -> None:
    with windows(daq) as source:
        assert source.contract == CONTRACT
        assert source.newest_window() == (None, float("inf"))
        ends = []
        for _ in range(5):
            window = wait_for(lambda: source.newest_window()[0])
            assert isinstance(window, np.ndarray)
            assert window.shape == (3, 600)
            ends.append(place_of(window))
        _, age_s = source.newest_window()
        assert 40 / 5120.0 < age_s < 10.0
    assert min(np.diff(ends)) >= 64


def test_no_window_spans_an_overrun(daq: VirtualDaq) -> None:
    with windows(daq) as source:
        first = wait_for(lambda: source.newest_window()[0])
        assert isinstance(first, np.ndarray)
        before = place_of(first)
        daq.do("overrun", samples=300)

        def after() -> int | None:
            window, _ = source.newest_window()
            if window is None:
                return None
            end = place_of(window)
            return end if end > before + 10_000 else None

        assert wait_for(after)
        assert source.fault() is None


def test_a_removed_module_ages_and_says_why(daq: VirtualDaq) -> None:
    with windows(daq) as source:
        wait_for(lambda: source.newest_window()[0])
        daq.do("remove", device="cDAQ1Mod1")
        fault = wait_for(source.fault)
        assert isinstance(fault, DeviceError)
        assert fault.code == "daq.removed"
        source.newest_window()
        window, age_s = source.newest_window()
        assert window is None
        time.sleep(0.05)
        assert source.newest_window()[1] >= age_s + 0.05


def test_a_module_that_is_plugged_in_again_delivers_on(daq: VirtualDaq) -> None:
    with windows(daq) as source:
        wait_for(lambda: source.newest_window()[0])
        daq.do("remove", device="cDAQ1Mod1")
        wait_for(source.fault)
        while source.newest_window()[0] is not None:
            pass
        daq.do("restore")
        again = wait_for(lambda: source.newest_window()[0])
        assert isinstance(again, np.ndarray)
        # A stretch of what the module measured after its return, and of nothing else.
        assert place_of(again) >= CONTRACT.n_samples
        wait_for(lambda: source.fault() is None)


def test_modules_that_come_back_in_another_order_are_not_served(daq: VirtualDaq) -> None:
    with windows(daq) as source:
        wait_for(lambda: source.newest_window()[0])
        daq.do("remove", device="cDAQ1Mod1")
        wait_for(source.fault)
        daq.do("swap")
        daq.do("restore")
        fault = wait_for(lambda: (found := source.fault()) is not None and found.code == "daq.channel_order" and found)
        assert isinstance(fault, DeviceError)
        time.sleep(0.1)
        source.newest_window()
        assert source.newest_window()[0] is None


def test_a_killed_reader_is_a_fault(daq: VirtualDaq) -> None:
    with windows(daq) as source:
        os.kill(source._process.pid, signal.SIGKILL)
        fault = wait_for(source.fault)
        assert isinstance(fault, DeviceError)
        assert fault.code == "daq.worker_died"


def test_another_rate_or_other_channels_are_refused(daq: VirtualDaq) -> None:
    other = WindowContract(5000.0, 600, 64, CONTRACT.channels, ("rms",))
    with pytest.raises(DeviceError) as caught:
        windows(daq, other)
    assert caught.value.code == "daq.rate"
    with pytest.raises(InputError) as order:
        DaqWindows(CONTRACT, CHANNELS[::-1], grpc_target=daq.target)
    assert order.value.code == "daq.channels"


def test_an_absent_module_is_named_at_once(daq: VirtualDaq) -> None:
    daq.do("remove", device="cDAQ1Mod1")
    with pytest.raises(DeviceError) as caught:
        windows(daq)
    assert caught.value.code == "daq.device_absent"


def test_close_frees_the_module(daq: VirtualDaq) -> None:
    first = windows(daq)
    wait_for(lambda: first.newest_window()[0])
    first.close()
    first.close()
    with windows(daq) as again:
        wait_for(lambda: again.newest_window()[0])
