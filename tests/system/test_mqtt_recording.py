"""What machines publish, recorded through a real broker by the real client."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mqtt_broker import running_broker
from mtconnect_agent import Agent, serving
from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion
from typer.testing import CliRunner

from dtwin.acquire._mqtt import MqttRecorder
from dtwin.acquire._stream_file import read_streams_file
from dtwin.acquire.campaign_folder import open_campaign
from dtwin.acquire.run_recording import RunRequest, record_run
from dtwin.acquire.signal_files import read_signals
from dtwin.cli import app
from dtwin.errors import DeviceError, InputError

pytestmark = pytest.mark.system
T0_S = 1_790_000_000.0


@contextmanager
def machine(port: int, *, retain: bool = False) -> Iterator[Callable[[str, Any], None]]:
    """Yield what publishes, and waits until the broker has it."""
    client = Client(CallbackAPIVersion.VERSION2)
    client.connect("127.0.0.1", port)
    client.loop_start()

    def publish(topic: str, what: Any) -> None:
        text = what if isinstance(what, str | bytes) else json.dumps(what)
        client.publish(topic, text, qos=1, retain=retain).wait_for_publish(10.0)

    try:
        yield publish
    finally:
        client.disconnect()
        client.loop_stop()


def recorder(port: int, **changes: Any) -> MqttRecorder:
    settings = {"columns": {"mill/x": "x_mm"}, "rate_hz": 20.0, "timeout_s": 5.0, "patience_s": 5.0}
    return MqttRecorder(f"127.0.0.1:{port}", **(settings | changes))


def until(
    device: MqttRecorder, enough: Callable[[dict[str, np.ndarray]], bool]
) -> tuple[dict[str, np.ndarray], list[Any]]:
    """Return columns and readings until they are enough."""
    readings = []
    limit = time.monotonic() + 300.0
    while True:
        readings.append(device.read())
        together = {n: np.concatenate([r.columns[n] for r in readings]) for n in readings[0].columns}
        if enough(together):
            return together, readings
        assert time.monotonic() < limit, together


def test_members_of_json_by_the_clock_of_the_sender(tmp_path: Path) -> None:
    columns = {"mill/axes#x.position": "x_mm", "mill/axes#load": "x_pct", "mill/temp": "spindle_c"}
    events = {"mill/alarm#text": "drive", "mill/program#name": "program"}
    with (
        running_broker(tmp_path) as port,
        machine(port) as publish,
        recorder(
            port, columns=columns, events=events, alarms=("mill/alarm#text",), clock="sender", time="at"
        ) as device,
    ):
        device.start()
        # Seconds, milliseconds, ISO 8601: all of the same clock, which is years beside this computer's.
        publish("mill/axes", {"at": T0_S, "x": {"position": 1.5}, "load": "12,5"})
        publish("mill/program", {"at": T0_S, "name": "O1"})
        publish("mill/temp", {"at": T0_S, "value": 21.0})
        publish("mill/axes", {"at": 1000.0 * (T0_S + 0.5), "x": {"position": 2.5}})
        publish("mill/alarm", {"at": "2026-09-21T14:13:20.700Z", "text": "hot"})
        publish("mill/alarm", {"at": T0_S + 0.9, "text": ""})
        publish("mill/axes", {"at": T0_S + 1.0, "x": {"position": 3.5}})
        found, readings = until(device, lambda c: len(c["x_mm"]) > 0 and c["x_mm"][-1] == 3.5)
        (refused,) = device.check()
    t_s = found["timestamp_s"] - T0_S
    assert t_s[:21] == pytest.approx(np.arange(21) * 0.05, abs=1e-5)
    assert found["x_mm"][:21].tolist() == [1.5] * 10 + [2.5] * 10 + [3.5]
    assert set(found["x_pct"]) == {12.5}
    # A mapping is no number: the topic names no member of it.
    assert np.isnan(found["spindle_c"]).all()
    assert refused.code == "mqtt.refused"
    said, *events_of = (e for r in readings for e in r.events)
    assert said.text.startswith("spindle_c: what came was no number")
    assert [(e.name, e.text, e.alarm) for e in events_of] == [
        ("program", "O1", False),
        ("drive", "hot", True),
        ("drive", "", True),
    ]
    assert [e.at_s for e in events_of] == pytest.approx([0.0, 0.7, 0.9], abs=1e-5)


def test_no_hours_are_made_of_a_message_of_yesterday_or_of_a_time_to_come(tmp_path: Path) -> None:
    changes = {"columns": {"mill#x": "x_mm", "hall#t": "hall_c"}, "clock": "sender", "time": "at"}
    with running_broker(tmp_path) as port, machine(port, retain=True) as publish, ExitStack() as stack:
        publish("hall", {"at": T0_S - 80_000.0, "t": 21.0})
        device = stack.enter_context(recorder(port, **changes))
        device.start()
        publish("mill", {"at": T0_S, "x": 1.0})
        publish("mill", {"at": T0_S + 4e8, "x": 2.0})
        publish("mill", {"at": T0_S + 1.0, "x": 3.0})
        found, readings = until(
            device, lambda c: len(c["x_mm"]) > 6000 or (c["x_mm"].size > 0 and c["x_mm"][-1] == 3.0)
        )
    assert found["timestamp_s"][0] == pytest.approx(T0_S)
    assert len(found["x_mm"]) < 6000
    assert set(found["hall_c"]) == {21.0}
    assert [e.text for r in readings for e in r.events] == [
        "mill: the sender's clock is +400000000 s ahead; times run on as before"
    ]


def test_plain_numbers_by_the_clock_of_this_computer(tmp_path: Path) -> None:
    with running_broker(tmp_path) as port, machine(port) as publish, recorder(port) as device:
        device.start()
        before = time.time()
        publish("mill/x", "1.25")
        publish("mill/x", "not a number")
        publish("mill/x", b"\xff\xfe")
        publish("mill/x", "1.25")
        publish("other", "9")
        found, _ = until(device, lambda c: np.isfinite(c["x_mm"]).sum() >= 5)
        assert device.check()[0].numbers == {"messages": 2.0}
    assert set(found["x_mm"][np.isfinite(found["x_mm"])]) == {1.25}
    assert before - 0.1 <= found["timestamp_s"][0] <= time.time()


@pytest.mark.parametrize("wrong", ["ERR", "null", "NaN", '{"at": %f, "x": null}'])
@pytest.mark.parametrize("clock", ["receiver", "sender"])
def test_what_is_no_number_is_missing_until_the_next_and_said(tmp_path: Path, wrong: str, clock: str) -> None:
    changes = {"clock": "sender", "time": "at", "columns": {"mill#x": "x_mm"}} if clock == "sender" else {}
    topic, now_s = ("mill" if clock == "sender" else "mill/x"), time.time()

    def number(value: float, later_s: float) -> Any:
        return {"at": now_s + later_s, "x": value} if clock == "sender" else value

    with running_broker(tmp_path) as port, machine(port) as publish, recorder(port, **changes) as device:
        device.start()
        publish(topic, number(1.0, 0.0))
        first, before = until(device, lambda c: len(c["x_mm"]) >= 5)
        publish(topic, wrong % (now_s + 1.0) if "%f" in wrong else wrong)
        missing, then = until(device, lambda c: bool(np.isnan(c["x_mm"]).any()))
        publish(topic, number(3.0, 3.0))
        _, after = until(device, lambda c: c["x_mm"].size > 0 and c["x_mm"][-1] == 3.0)
        (finding,) = device.check()
    assert set(first["x_mm"]) == {1.0}
    assert set(missing["x_mm"][np.isnan(missing["x_mm"]).argmax() :].astype(str)) == {"nan"}
    assert finding.numbers == {"messages": 1.0}
    said = [e.text for r in (*before, *then, *after) for e in r.events if e.name == "recording"]
    (text,) = said
    assert text.startswith("x_mm: what came was no number")


def test_a_broker_that_comes_back_leaves_a_gap(tmp_path: Path) -> None:
    stop = threading.Event()

    def work() -> None:
        # Until the recorder has subscribed again.
        with machine(port) as publish:
            while not stop.wait(0.1):
                publish("mill/x", "2")

    thread = threading.Thread(target=work)
    with ExitStack() as held:
        with running_broker(tmp_path) as port:
            device = held.enter_context(recorder(port, patience_s=25.0))
            device.start()
            with machine(port) as publish:
                publish("mill/x", "1")
            until(device, lambda c: len(c["x_mm"]) >= 5)
        # So long that a starved computer notices it, too.
        time.sleep(4.0)
        held.enter_context(running_broker(tmp_path, port))
        thread.start()
        held.callback(thread.join)
        held.callback(stop.set)
        found, readings = until(device, lambda c: len(c["x_mm"]) > 0 and c["x_mm"][-1] == 2.0)
    assert [r.reason for r in readings if r.lost] == ["the broker could not be reached"]
    assert np.diff(found["timestamp_s"]).min() > 0.04


def test_a_clock_that_is_set_back_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with running_broker(tmp_path) as port, machine(port) as publish, recorder(port) as device:
        device.start()
        publish("mill/x", 1.0)
        until(device, lambda read: read["x_mm"].size > 0)
        now_s = time.time
        monkeypatch.setattr("time.time", lambda: now_s() - 7200.0)
        publish("mill/x", 2.0)
        read, _ = until(device, lambda read: bool((read["x_mm"] == 2.0).any()))
        assert (np.diff(read["timestamp_s"]) > 0.0).all()


def test_silence_is_said(tmp_path: Path) -> None:
    with running_broker(tmp_path) as port, recorder(port, patience_s=0.3) as device:
        device.start()
        with pytest.raises(DeviceError) as caught:
            device.read()
    assert caught.value.code == "mqtt.silent"


def test_a_recording_that_is_ended_waits_for_no_message(tmp_path: Path) -> None:
    request, asked = RunRequest(tmp_path / "c", "c", "m", "r1", None, "r1.b5r"), iter(range(10**6))
    with running_broker(tmp_path) as port, pytest.raises(DeviceError) as caught:
        record_run([recorder(port, patience_s=3600.0)], request, lambda: next(asked) > 5)
    assert caught.value.code == "mqtt.silent"


def test_a_broker_that_freezes_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dtwin.acquire._mqtt._KEEP_ALIVE_S", 1)
    started: list[subprocess.Popen[bytes]] = []
    with running_broker(tmp_path, started=started) as port, recorder(port, patience_s=1.0) as device:
        device.start()
        with machine(port) as publish:
            publish("mill/x", 1.0)
        until(device, lambda read: read["x_mm"].size > 0)
        started[0].send_signal(signal.SIGSTOP)
        with pytest.raises(DeviceError) as caught:
            until(device, lambda read: False)
        started[0].send_signal(signal.SIGCONT)
    assert caught.value.code == "mqtt.silent"


@contextmanager
def false_broker(granted: int, sent: bytes = b"") -> Iterator[int]:
    """Yield the port of what answers as a broker does, grants a subscription by this code and sends something once."""
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def answer() -> None:
            connection, _ = listener.accept()
            with connection, suppress(OSError):
                connection.recv(4096)
                connection.sendall(b"\x20\x02\0\0")
                number = connection.recv(4096)[2:4]
                connection.sendall(b"\x90\x03" + number + bytes([granted]) + sent)
                while connection.recv(4096):
                    pass

        threading.Thread(target=answer, daemon=True).start()
        yield int(listener.getsockname()[1])


def test_a_topic_that_is_no_text_is_refused_and_ends_nothing() -> None:
    """It ended the client's thread: the last value held for ever, and nothing was said."""
    sent = b"".join(bytes([0x30, 9]) + b"\0\6" + topic + b"7" for topic in (b"\xffill/x", b"mill/x"))
    with false_broker(1, sent) as port, recorder(port) as device:
        device.start()
        until(device, lambda read: 7.0 in read["x_mm"])
        (finding,) = device.check()
    assert finding.numbers == {"messages": 1.0}


def test_a_topic_that_may_not_be_read_is_said() -> None:
    with false_broker(0x80) as port, pytest.raises(DeviceError, match="may not read mill/x") as caught:
        recorder(port).open()
    assert caught.value.code == "mqtt.absent"


def test_more_bytes_than_may_wait_are_refused_until_the_others_were_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dtwin.acquire._mqtt._MOST_WAITING_BYTES", 9)
    with running_broker(tmp_path) as port, machine(port) as publish, recorder(port) as device:
        device.start()
        for text in ("1.23456789", "1.2345678", "2.3456789"):
            publish("mill/x", text)
            if len(text) <= 9:
                until(device, lambda together, value=float(text): value in together["x_mm"])
        (finding,) = device.check()
    assert finding.numbers == {"messages": 1.0}


def test_a_time_in_nanoseconds_is_none(tmp_path: Path) -> None:
    """A float tells them to a quarter of a minute: no sample would follow on another."""
    changes = {"columns": {"mill#x": "x_mm"}, "clock": "sender", "time": "at", "patience_s": 0.3}
    with running_broker(tmp_path) as port, machine(port) as publish, recorder(port, **changes) as device:
        device.start()
        publish("mill", {"at": 1e9 * T0_S, "x": 1.5})
        with pytest.raises(DeviceError) as caught:
            device.read()
    assert (caught.value.code, caught.value.got) == (
        "mqtt.silent",
        "0.3 s without a message that can be used, 1 refused",
    )


def test_the_command_records_a_run_of_both(tmp_path: Path) -> None:
    agent = Agent()
    agent.now_s = time.time()
    agent.observe("stemp", "23.5")
    agent.observe("prog", "O7")
    stop = threading.Event()

    def work() -> None:
        # What nobody hears yet is not kept: it is told as long as somebody records.
        while not stop.wait(0.02):
            agent.now_s = time.time()
            agent.observe("xpos", str(agent.next))
            publish("hall/temperature", "19.5")

    with running_broker(tmp_path) as port, machine(port) as publish, serving(agent) as url:
        streams = tmp_path / "streams.toml"
        streams.write_text(
            f'[mtconnect]\nurl = "{url}"\nrate_hz = 20\n[mqtt]\nbroker = "127.0.0.1:{port}"\nrate_hz = 20\n'
            '[mqtt.columns]\n"hall/temperature" = "hall_c"\n',
            encoding="utf-8",
        )
        thread = threading.Thread(target=work)
        thread.start()
        folder = tmp_path / "c"
        done = CliRunner().invoke(
            app,
            [
                *("record", "--streams", str(streams), "--out", str(folder), "--duration", "2", "--machine", "mill-7"),
                *("--set", "plane=XY", "--set", "direction=CCW", "--set", "radius_mm=100", "--set", "feed_mm_min=1000"),
            ],
        )
        stop.set()
        thread.join()
    assert done.exit_code == 0, done.output
    names = sorted(p.name for p in folder.glob("*.parquet"))
    assert names == ["r001.mqtt.parquet", "r001.mtconnect.parquet"]
    (agent_group,) = read_signals(folder / "r001.mtconnect.parquet")
    assert agent_group.n_samples >= 40
    (entry,) = open_campaign(folder).entries
    assert entry.stated["covariates"] == {"stemp_c": pytest.approx(23.5), "hall_c": pytest.approx(19.5)}
    angle = np.linspace(0.0, 6.0, 50)
    rows = [f"{t:.3f},{np.degrees(a):.4f},{np.sin(a):.4f}" for t, a in enumerate(angle)]
    (folder / "r001.csv").write_text("\n".join(["t_s,angle_deg,deviation_um", *rows]) + "\n", encoding="utf-8")
    text = (folder / "campaign.toml").read_text(encoding="utf-8").replace("r001.b5r", "r001.csv")
    (folder / "campaign.toml").write_text(text, encoding="utf-8")
    ((run,), _) = next(iter(open_campaign(folder)))
    assert {g.name for g in run.signals} == {"mqtt", "mtconnect"}
    assert any(f.message.startswith("program: O7 0.0 to") for f in run.findings)


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("", "file.empty"),
        ("[opcua]\nurl = 'x'\n", "stream.file"),
        ("[mtconnect]\nrate_hz = 10\n", "stream.setting"),
        ("[mtconnect]\nurl = 'http://h:1'\nspeed = 10\n", "stream.setting"),
        ("[mtconnect]\nurl = 'http://h:1'\nrate_hz = 1e9\n", "stream.value"),
        ("[mtconnect]\nurl = 'http://h:1'\ncount = true\n", "stream.value"),
        ("[mqtt]\nbroker = 'h:1883'\n", "stream.setting"),
        ("[mqtt]\nbroker = 'h'\n[mqtt.columns]\n'a' = 'x_mm'\n", "mqtt.broker"),
        ("[mqtt]\nbroker = 'me:secret@h:1'\n[mqtt.columns]\n'a' = 'x_mm'\n", "mqtt.broker"),
        ("[mqtt]\nbroker = 'h:1'\n[mqtt.columns]\n'a' = 'x'\n", "units.unknown"),
        ("[mqtt]\nbroker = 'h:1'\n[mqtt.columns]\n'a/+' = 'x_mm'\n", "mqtt.topic"),
        ("[mqtt]\nbroker = 'h:1'\n[mqtt.columns]\n'a/#' = 'x_mm'\n", "mqtt.topic"),
        ("[mqtt]\nbroker = 'h:1'\nclock = 'sender'\n[mqtt.columns]\n'a' = 'x_mm'\n", "mqtt.settings"),
        ("[mqtt]\nbroker = 'h:1'\n[mqtt.columns]\n'a' = 'x_mm'\n'b' = 'x_mm'\n", "mqtt.settings"),
        ("[mqtt\n", "stream.file"),
    ],
)
def test_a_stream_file_that_is_wrong_is_said(text: str, code: str, tmp_path: Path) -> None:
    path = tmp_path / "streams.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        read_streams_file(path)
    assert caught.value.code == code
    assert "secret" not in str(caught.value)
