"""One test of conduct for every registered instrument and machine, with the real clients."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from serial_peer import serial_peer
from system.mqtt_broker import running_broker
from system.mtconnect_agent import Agent, serving
from system.virtual_daq import virtual_daq
from system.virtual_robot import free_address, virtual_robot

from dtwin.acquire._recording import Recorder
from dtwin.acquire._recovery import seal
from dtwin.acquire.instrument import Instrument, record
from dtwin.acquire.instruments import _ENTRIES, bench, instrument
from dtwin.acquire.runner import Bench
from dtwin.acquire.signal_files import read_signals
from dtwin.errors import DeviceError, InputError, MissingPart
from dtwin.plan import PlannedTest
from dtwin.units import unit_of

pytestmark = pytest.mark.system

Settings = Mapping[str, Any]
CHANNELS = [{"name": "wrist_x_g", "physical": "cDAQ1Mod1/ai0"}]


@contextmanager
def daq_settings() -> Iterator[Settings]:
    with virtual_daq() as peer:
        yield {"channels": CHANNELS, "rate_hz": 5120.0, "grpc_target": peer.target}


@contextmanager
def serial_settings() -> Iterator[Settings]:
    with serial_peer() as peer:
        peer.stream(2, 200.0)
        yield {"port": peer.port, "columns": ("force_n", "temperature_c"), "rate_hz": 200.0}


@contextmanager
def robot_settings() -> Iterator[Settings]:
    with virtual_robot() as peer:
        yield {"host": peer.host}


@contextmanager
def agent_settings() -> Iterator[Settings]:
    agent, stop = Agent(), threading.Event()
    agent.now_s = time.time()

    def work() -> None:
        while not stop.wait(0.01):
            agent.now_s = time.time()
            agent.observe("xpos", str(agent.next))

    with serving(agent) as url:
        thread = threading.Thread(target=work)
        thread.start()
        try:
            yield {"url": url, "rate_hz": 50.0, "poll_s": 0.01}
        finally:
            stop.set()
            thread.join()


@contextmanager
def broker_settings() -> Iterator[Settings]:
    from paho.mqtt.client import Client
    from paho.mqtt.enums import CallbackAPIVersion

    with TemporaryDirectory() as folder, running_broker(Path(folder)) as port:
        machine, stop = Client(CallbackAPIVersion.VERSION2), threading.Event()
        machine.connect("127.0.0.1", port)
        machine.loop_start()

        def work() -> None:
            n = 0
            while not stop.wait(0.01):
                n += 1
                machine.publish("mill/x", str(n), qos=1)

        thread = threading.Thread(target=work)
        thread.start()
        try:
            yield {"broker": f"127.0.0.1:{port}", "columns": {"mill/x": "x_mm"}, "rate_hz": 50.0}
        finally:
            stop.set()
            thread.join()
            machine.disconnect()
            machine.loop_stop()


PEERS: dict[str, Callable[[], AbstractContextManager[Settings]]] = {
    "accelerometers": daq_settings,
    "serial": serial_settings,
    "controller": robot_settings,
    "mtconnect": agent_settings,
    "mqtt": broker_settings,
}
ABSENT: dict[str, Settings] = {
    "accelerometers": {"channels": CHANNELS, "rate_hz": 5120.0, "grpc_target": "127.0.0.1:1", "timeout_s": 0.2},
    "serial": {"port": "/dev/ttyNotThere", "columns": ("force_n",), "rate_hz": 200.0},
    "controller": {"host": free_address(), "timeout_s": 0.5},
    "mtconnect": {"url": f"http://{free_address()}:5000", "timeout_s": 0.5},
    "mqtt": {"broker": f"{free_address()}:1883", "columns": {"mill/x": "x_mm"}, "timeout_s": 0.5},
}
INSTRUMENTS = [name for name, entry in _ENTRIES.items() if entry.role == "instrument"]
BENCHES = [name for name, entry in _ENTRIES.items() if entry.role == "bench"]


@pytest.fixture(scope="module", params=INSTRUMENTS)
def present(request: pytest.FixtureRequest) -> Iterator[tuple[str, Settings]]:
    # A registered instrument without a peer fails here: it would go untested.
    with PEERS[request.param]() as settings:
        yield request.param, settings


@pytest.fixture
def device(present: tuple[str, Settings]) -> Instrument:
    name, settings = present
    return instrument(name, **settings)


def test_it_keeps_the_protocol_and_says_what_it_is(device: Instrument) -> None:
    assert isinstance(device, Instrument)
    entry = _ENTRIES[device.name]
    assert entry.measures
    assert entry.needs


def test_its_columns_have_units_and_fit_what_it_reads(device: Instrument) -> None:
    with device:
        described = device.describe()
        assert described.rate_hz > 0
        for column, kind in described.columns.items():
            assert kind.kind in "iu" or unit_of(column) is not None
        device.check()
        device.start()
        reading = device.read()
        device.stop()
    assert set(reading.columns) == set(described.columns)
    assert reading.n_samples > 0
    assert {len(values) for values in reading.columns.values()} == {reading.n_samples}
    for column, values in reading.columns.items():
        assert np.can_cast(values.dtype, described.columns[column], "same_kind")


def test_it_records_into_a_file_that_reads_back(device: Instrument, tmp_path: Path) -> None:
    with device:
        described = device.describe()
        stream = tmp_path / "r1.arrows"
        with Recorder(stream, described.group, described.rate_hz, described.columns, notes=described.notes) as recorder:
            device.start()
            taken = record(device, recorder, lambda n: n < 40)
            device.stop()
    sealed = seal(stream, tmp_path / "r1.parquet")
    assert sealed.complete
    (group,) = read_signals(sealed.path)
    assert group.name == described.group
    assert group.n_samples == taken >= 40


def test_it_can_be_stopped_and_closed_at_any_time_and_opened_again(device: Instrument) -> None:
    device.stop()
    device.close()
    for _ in range(2):
        device.open()
        device.start()
        device.read()
        device.stop()
        device.stop()
        device.close()
        device.close()


def test_two_readings_are_different_samples(device: Instrument) -> None:
    with device:
        device.start()
        first, second = device.read(), device.read()
    varying = next(iter(first.columns))
    both = np.concatenate([first.columns[varying], second.columns[varying]])
    assert len(np.unique(both)) > 1


def test_unopened_it_refuses_to_read(device: Instrument) -> None:
    with pytest.raises(DeviceError):
        device.read()


@pytest.mark.parametrize("name", INSTRUMENTS)
def test_absent_it_says_so_in_one_line_and_closes(name: str) -> None:
    device = instrument(name, **ABSENT[name])
    with pytest.raises((DeviceError, MissingPart)) as caught:
        device.open()
    assert caught.value.hint
    assert "\n" not in caught.value.message
    device.stop()
    device.close()


@pytest.mark.parametrize("name", BENCHES)
def test_a_bench_measures_a_planned_test(name: str) -> None:
    machine = bench(name)
    assert isinstance(machine, Bench)
    assert {"machine_geometry", "instrument"} <= set(machine.describe())
    machine.warm_up()
    test = PlannedTest("t1", "XY", 100.0, 6000.0, 1, "s1")
    run = machine.measure(test, "CCW")
    assert run.meta.direction == "CCW"
    assert {"t_s", "angle_deg", "deviation_um"} <= set(run.samples)
    for column, values in run.samples.items():
        assert values.dtype.kind in "iu" or unit_of(column) is not None
    for group in run.signals:
        assert group.rate_hz > 0
        assert group.n_samples > 0
        for column, values in group.columns.items():
            assert values.dtype.kind in "iu" or unit_of(column) is not None
    machine.close()
    machine.close()


def test_every_entry_is_tested() -> None:
    assert set(PEERS) == set(INSTRUMENTS) == set(ABSENT)
    assert sorted(INSTRUMENTS + BENCHES) == sorted(_ENTRIES)


def test_unknown_names_and_settings_are_refused() -> None:
    for make in (instrument, bench):
        with pytest.raises(InputError) as caught:
            make("theodolite")
        assert caught.value.code == "instrument.unknown"
        assert caught.value.allowed
    with pytest.raises(InputError) as settings:
        instrument("controller", address="127.0.0.1")
    assert settings.value.code == "instrument.settings"
