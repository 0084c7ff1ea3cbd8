"""A machine with an MTConnect agent: documents of the standard's form over real HTTP, written by us."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import SimpleNamespace
from xml.etree.ElementTree import Element, SubElement, tostring

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from system.mtconnect_agent import BEGUN_S, DEVICE, Agent, serving

from dtwin.acquire._mtconnect import MTConnectRecorder
from dtwin.acquire._mtconnect_documents import Item, read_probe, read_streams
from dtwin.acquire._recording import Recorder
from dtwin.acquire._recovery import _event_findings, covariates_of, seal, signal_findings
from dtwin.acquire.instrument import Reading, record
from dtwin.errors import DeviceError, InputError


@pytest.fixture
def agent() -> Agent:
    return Agent()


@pytest.fixture
def url(agent: Agent) -> Iterator[str]:
    with serving(agent) as address:
        yield address


def recorder(url: str, **changes: object) -> MTConnectRecorder:
    settings: dict[str, object] = {"rate_hz": 10.0, "poll_s": 0.01, "timeout_s": 2.0, "patience_s": 0.3}
    return MTConnectRecorder(url, **(settings | changes))  # type: ignore[arg-type]


def until(device: MTConnectRecorder, time_s: float) -> list[Reading]:
    """Return the readings up to a time after the beginning."""
    found: list[Reading] = []
    while (
        not found
        or not len(found[-1].columns["timestamp_s"])
        or found[-1].columns["timestamp_s"][-1] < BEGUN_S + time_s - 0.05
    ):
        found.append(device.read())
    return found


def column(readings: list[Reading], name: str) -> np.ndarray:
    return np.concatenate([r.columns[name] for r in readings])


def test_numbers_hold_until_the_next_in_the_units_of_the_house(agent: Agent, url: str) -> None:
    for item, text in (("xpos", "1.5"), ("stemp", "21.5"), ("sspeed", "3000"), ("prog", "O1"), ("ppos", "1 2 3")):
        agent.observe(item, text, -3600.0)
    with recorder(url) as device:
        assert set(device.describe().columns) == {
            *("timestamp_s", "xact_mm", "xload_pct", "sspeed_hz", "stemp_c", "path_x_mm", "path_y_mm", "path_z_mm")
        }
        (left,) = device.check()
        assert "TIME_SERIES is not read" in left.message
        assert "unit x:SMILE" in left.message
        device.start()
        agent.observe("xpos", "2.5", 0.25)
        agent.observe("xpos", "UNAVAILABLE", 0.45)
        agent.now_s = BEGUN_S + 0.6
        found = until(device, 0.6)
    assert column(found, "timestamp_s") == pytest.approx(BEGUN_S + np.arange(7) * 0.1, abs=1e-5)
    assert column(found, "xact_mm").tolist()[:5] == [1.5, 1.5, 1.5, 2.5, 2.5]
    assert np.isnan(column(found, "xact_mm")[5:]).all()
    assert set(column(found, "sspeed_hz")) == {50.0}
    assert set(column(found, "path_z_mm")) == {3.0}
    assert np.isnan(column(found, "xload_pct")).all()


def test_small_answers_come_in_order_and_nothing_is_lost(agent: Agent, url: str) -> None:
    with recorder(url, count=7) as device:
        device.start()
        for n in range(100):
            agent.observe("xpos", str(n), (n + 1) / 10.0)
        agent.now_s = BEGUN_S + 10.0
        found = until(device, 10.0)
    assert column(found, "xact_mm").tolist()[1:] == [float(n) for n in range(100)]
    assert not any(r.lost for r in found)


@pytest.mark.parametrize("style", ["old", "new"])
def test_what_the_buffer_lost_is_a_gap(agent: Agent, url: str, style: str) -> None:
    agent.buffer, agent.style = 20, style
    agent.observe("stemp", "20", -5.0)
    with recorder(url) as device:
        device.start()
        until(device, 0.0)
        for n in range(100):
            agent.observe("xpos", str(n), n / 10.0)
        agent.now_s = BEGUN_S + 9.9
        found = until(device, 9.9)
    lost = [r for r in found if r.lost]
    assert [r.reason for r in lost] == ["observations that the agent's buffer no longer held"]
    # The clock stays right: what was lost counts.
    assert lost[0].lost == 98
    assert column(found, "timestamp_s")[0] == pytest.approx(BEGUN_S + 9.9, abs=1e-5)
    assert column(found, "xact_mm").tolist() == [99.0]
    assert column(found, "stemp_c").tolist() == [20.0]


@pytest.mark.parametrize("further", [False, True])
def test_a_restarted_agent_is_told_and_followed(agent: Agent, url: str, further: bool) -> None:
    agent.observe("xpos", "1", -1.0)
    agent.observe("stemp", "20", -1.0)
    with recorder(url) as device:
        device.start()
        agent.now_s = BEGUN_S + 1.0
        until(device, 1.0)
        agent.restart()
        agent.now_s = BEGUN_S + 3.0
        for n in range(20 if further else 1):
            # It counts beyond the number that is asked for next, or not so far.
            agent.observe("xpos", str(n), 2.9)
        found = until(device, 3.0)
    assert [r.reason for r in found if r.lost] == ["the agent was restarted"]
    assert sum(r.lost for r in found) == 19
    assert column(found, "xact_mm")[-1] == (19.0 if further else 0.0)
    # The new one has not said it yet.
    assert np.isnan(column(found, "stemp_c")[-1])


def test_an_agent_that_was_away_has_kept_everything(agent: Agent, url: str) -> None:
    agent.observe("xpos", "1", -1.0)
    with recorder(url, patience_s=20.0) as device:
        device.start()
        until(device, 0.0)
        agent.down = True
        for n in range(5):
            agent.observe("xpos", str(n), 0.1 * (n + 1))
        agent.now_s = BEGUN_S + 0.5
        import threading

        back = threading.Timer(0.3, lambda: setattr(agent, "down", False))
        back.start()
        found = until(device, 0.5)
        back.join()
    assert column(found, "xact_mm").tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert not any(r.lost for r in found)


@pytest.mark.parametrize("step_s", [7200.0, -2400.0, -1.7e9])
def test_a_clock_that_is_set_meanwhile_makes_no_values_and_no_end(
    agent: Agent, url: str, monkeypatch: pytest.MonkeyPatch, step_s: float
) -> None:
    passed = [0.0]
    clock = SimpleNamespace(monotonic=lambda: passed[0], sleep=time.sleep)
    monkeypatch.setattr("dtwin.acquire._mtconnect.time", clock)
    agent.observe("xpos", "1.0", 0.0)
    with recorder(url) as device:
        device.start()
        agent.now_s, passed[0] = BEGUN_S + 0.3, 0.3
        agent.observe("xpos", "2.0", 0.3)
        readings = until(device, 0.3)
        agent.observe("xpos", "3.0", 0.4)
        agent.observe("xpos", "4.0", 0.5 + step_s)
        agent.now_s, passed[0] = BEGUN_S + 0.6 + step_s, 0.6
        readings += until(device, 0.5)
        device.stop()
    assert column(readings, "xact_mm").tolist()[:6] == [1.0, 1.0, 1.0, 2.0, 3.0, 4.0]
    assert len(column(readings, "xact_mm")) <= 8
    assert [e.text for r in readings for e in r.events if "clock" in e.text] != []


@pytest.mark.parametrize(
    ("status", "body", "told"),
    [
        (503, b"<html>starting</html>", 0),
        (200, b"<html><body>Sign in</body></html>", 1),
        (200, b"<!DOCTYPE html><p>Sign in<br>", 1),
        (200, b'<?xml version="1.0"?><MTConnectStreams><Header nextSequ', 1),
        (200, b"", 1),
    ],
    ids=("starting", "page", "old page", "cut off", "nothing"),
)
def test_an_agent_that_is_not_ready_yet_is_waited_for(
    agent: Agent, url: str, monkeypatch: pytest.MonkeyPatch, status: int, body: bytes, told: int
) -> None:
    agent.observe("xpos", "1.0", 0.0)
    with recorder(url, patience_s=30.0) as device:
        device.start()
        answer, refused = agent.answer, [body] * 3
        monkeypatch.setattr(agent, "answer", lambda path: (status, refused.pop()) if refused else answer(path))
        agent.now_s = BEGUN_S + 0.5
        readings = until(device, 0.5)
        device.stop()
    assert len(column(readings, "xact_mm")) >= 5
    assert refused == []
    assert len([e.text for r in readings for e in r.events if "asked again" in e.text]) == told


def test_an_agent_in_whose_place_a_page_stays_is_said(agent: Agent, url: str) -> None:
    with recorder(url) as device:
        device.start()
        until(device, 0.0)
        agent.body = b"<html><body>Sign in</body></html>"
        with pytest.raises(DeviceError) as caught:
            until(device, 5.0)
    assert caught.value.code == "mtconnect.document"


def test_an_agent_whose_answers_stay_the_same_is_said(agent: Agent, url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dtwin.acquire._mtconnect._CLOCK_SET_S", 0.2)
    with recorder(url) as device:
        device.start()
        until(device, 0.0)
        with pytest.raises(DeviceError) as caught:
            until(device, 5.0)
    assert caught.value.code == "mtconnect.still"


def test_an_agent_that_stays_away_is_said(agent: Agent, url: str) -> None:
    with recorder(url) as device:
        device.start()
        until(device, 0.0)
        agent.down = True
        with pytest.raises(DeviceError) as caught:
            until(device, 5.0)
    assert caught.value.code == "mtconnect.absent"


def test_a_recording_that_is_ended_waits_for_no_agent_that_is_away(agent: Agent, url: str) -> None:
    with recorder(url, patience_s=3600.0) as device:
        device.start()
        until(device, 0.0)
        device.hurry()
        device.read()
        assert device.check()[-1].code == "mtconnect.left_out"
        agent.down = True
        device.read()
        assert device.check()[-1].code == "mtconnect.away"


def test_a_refusal_that_breaks_off_is_said() -> None:
    over = threading.Event()

    class Cut(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.wfile.write(b"HTTP/1.1 400 Bad Request\r\nContent-Length: 900\r\n\r\nno")
            over.wait(10.0)

        def log_message(self, *_: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Cut) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.02,))
        thread.start()
        try:
            with pytest.raises(DeviceError, match="refuses"):
                recorder(f"http://127.0.0.1:{server.server_address[1]}", patience_s=0.5, timeout_s=0.2).open()
        finally:
            over.set()
            server.shutdown()
            thread.join()


@pytest.mark.parametrize("begin", [b"HTTP/1.0 200 OK\r\n\r\n", b"HTTP/1.0 200 OK\r\nX: "])
def test_an_answer_that_never_ends_is_given_up(begin: bytes) -> None:
    """As of an agent that hangs in its answer, or its head: each byte comes before the timeout."""
    over = threading.Event()

    class Dripping(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.wfile.write(begin)
            with contextlib.suppress(OSError):
                while not over.wait(0.05):
                    self.wfile.write(b"<")

        def log_message(self, *_: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Dripping) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.02,))
        thread.start()
        try:
            with pytest.raises(DeviceError, match="does not answer") as caught:
                recorder(f"http://127.0.0.1:{server.server_address[1]}", patience_s=0.5).open()
            assert "did not end" in (caught.value.got or "")
        finally:
            over.set()
            server.shutdown()
            thread.join()


def test_programs_and_alarms_become_intervals_with_the_run(agent: Agent, url: str, tmp_path: Path) -> None:
    agent.observe("prog", "O1", -60.0)
    agent.observe("xcond", "", -60.0, tag="Normal")
    agent.observe("stemp", "20", -60.0)
    with recorder(url) as device:
        described = device.describe()
        stream = tmp_path / "r1.mtconnect.arrows"
        with Recorder(stream, described.group, described.rate_hz, described.columns, notes=described.notes) as kept:
            device.start()
            agent.observe("xcond", "Drive hot", 1.0, tag="Warning", code="A7")
            agent.observe("xcond", "Drive off", 2.0, tag="Fault", code="A9")
            agent.observe("xcond", "", 3.0, tag="Normal", code="A7")
            agent.observe("prog", "O2 <&> ".replace("<", "&lt;").replace("&>", "&amp;&gt;"), 4.0)
            agent.observe("line", "17", 4.0)
            agent.observe("stemp", "24", 4.0)
            agent.observe("xcond", "", 6.0, tag="Normal")
            agent.now_s = BEGUN_S + 7.9
            record(device, kept, lambda n: n < 80)
            device.stop()
    sealed = seal(stream, tmp_path / "r1.mtconnect.parquet")
    assert sealed.n_samples == 80
    told = [f.message for f in signal_findings(sealed.path)]
    assert told == [
        "the machine reported Xdrive A7: Warning: Drive hot 1.0 to 3.0 s",
        "the machine reported Xdrive A9: Fault: Drive off 2.0 to 6.0 s",
        "program: O1 0.0 to 4.0 s, O2 <&> 4.0 to 8.0 s",
    ]
    assert covariates_of(sealed.path) == {"stemp_c": pytest.approx(22.0)}


def test_a_killed_recording_keeps_its_events(tmp_path: Path) -> None:
    stream = tmp_path / "r1.mtconnect.arrows"
    kept = Recorder(stream, "mtconnect", 1.0, {"x_mm": np.dtype(float)})
    kept.append({"x_mm": np.array([1.0, 2.0])})
    kept.say([(0.5, "Xdrive", "Fault", True)])
    kept.append({"x_mm": np.array([3.0])})
    kept.abandon()
    sealed = seal(stream, tmp_path / "r1.mtconnect.parquet")
    assert sealed.n_samples == 3
    assert [f.code for f in signal_findings(sealed.path)] == ["recording.incomplete", "machine.alarm"]


def test_many_alarms_are_counted(tmp_path: Path) -> None:
    events = [(float(n), f"a{n}", "Fault", True) for n in range(30)]
    found = _event_findings(events, 40.0)
    assert len(found) == 21
    assert found[-1].message == "the machine reported 10 alarms more"


@pytest.mark.parametrize(
    ("body", "code"),
    [
        (b"<html><body>hello</body></html>", "mtconnect.document"),
        (b"", "xml.malformed"),
        (b'<!DOCTYPE x [<!ENTITY a "b">]><MTConnectDevices>&a;</MTConnectDevices>', "xml.hostile"),
        (b"<MTConnectDevices>" + b"<a>" * 60 + b"</a>" * 60 + b"</MTConnectDevices>", "xml.absurd"),
        (b"<MTConnectDevices><Devices/></MTConnectDevices>", "mtconnect.device"),
        (b"<MTConnectDevices><Devices><Device name='a'/></Devices></MTConnectDevices>", "mtconnect.nothing"),
        (b"x" * 17_000_000, "mtconnect.size"),
    ],
)
def test_what_is_no_agent_is_refused(agent: Agent, url: str, body: bytes, code: str) -> None:
    agent.body = body
    with pytest.raises((DeviceError, InputError)) as caught:
        recorder(url).open()
    assert caught.value.code == code


def test_one_of_several_devices_is_named(agent: Agent, url: str) -> None:
    agent.extra = DEVICE.replace("mill-7", "mill-8").replace("M-7", "M-8")
    with pytest.raises(InputError, match="several devices") as caught:
        recorder(url).open()
    assert caught.value.allowed == "mill-7, mill-8"
    with recorder(url, device="mill-8") as device:
        assert device.describe().notes["device"] == "mill-8"


@pytest.mark.parametrize("address", ["ftp://x", "http://", "192.168.0.7:5000", "http://u:p@h/", "http://h:99999"])
def test_an_address_that_is_none(address: str) -> None:
    with pytest.raises(InputError) as caught:
        MTConnectRecorder(address)
    assert caught.value.code == "mtconnect.url"
    assert "u:p" not in str(caught.value)


def test_a_redirection_is_not_followed(agent: Agent) -> None:
    from http.server import BaseHTTPRequestHandler, HTTPServer
    from threading import Thread

    class Elsewhere(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(302)
            self.send_header("Location", target)
            self.end_headers()

        def log_message(self, *_: object) -> None:
            pass

    with serving(agent) as target, HTTPServer(("127.0.0.1", 0), Elsewhere) as server:
        thread = Thread(target=server.serve_forever, args=(0.02,))
        thread.start()
        try:
            with pytest.raises(DeviceError, match="refuses"):
                recorder(f"http://127.0.0.1:{server.server_address[1]}").open()
        finally:
            server.shutdown()
            thread.join()
    assert agent.answers == 0


@pytest.mark.parametrize(
    ("ahead_s", "waiting", "why"), [(1e9, 9, "clock is more than an hour off"), (0.1, 0, "time does not come")]
)
def test_a_stamp_far_away_is_left_out_and_so_is_more_than_may_wait(
    agent: Agent, url: str, monkeypatch: pytest.MonkeyPatch, ahead_s: float, waiting: int, why: str
) -> None:
    agent.observe("xpos", "1", -1.0)
    with recorder(url) as device:
        device.start()
        device.read()
        monkeypatch.setattr("dtwin.acquire._held._MOST_WAITING", waiting)
        agent.observe("xpos", "7", ahead_s)
        agent.now_s = BEGUN_S + 0.3
        found = until(device, 0.3)
    assert set(column(found, "xact_mm")) == {1.0}
    assert [e.text for r in found for e in r.events if e.name == "recording"] == [
        f"values of xact_mm and perhaps others, whose {why}, are left out"
    ]


PLAIN = {"a": Item("a", ("a_mm",)), "b": Item("b"), "c": Item("c", condition=True)}
TEXTS = st.text(max_size=30)


@settings(max_examples=150, deadline=None)
@given(st.one_of(st.binary(max_size=300), TEXTS.map(str.encode)))
def test_hostile_answers_are_refused_as_such(data: bytes) -> None:
    for read in (lambda: read_probe(data, "x", ""), lambda: read_streams(data, "x", PLAIN)):
        with pytest.raises((DeviceError, InputError)):
            read()


@settings(max_examples=150, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.sampled_from("abcz"), TEXTS, st.sampled_from(["Position", "Fault", "Normal", "x"]), st.integers(0, 9)
        ),
        max_size=12,
    )
)
def test_whatever_is_observed_is_a_number_or_a_text_in_its_order(rows: list[tuple[str, str, str, int]]) -> None:
    root = Element("MTConnectStreams")
    SubElement(root, "Header", nextSequence="9", firstSequence="1", instanceId="7", creationTime="2026-01-01T00:00:00Z")
    for item, text, tag, number in rows:
        about = {"dataItemId": item, "timestamp": "2026-01-01T00:00:00Z", "sequence": str(number)}
        SubElement(root, tag, about).text = "".join(c for c in text if c.isprintable())
    header, found = read_streams(tostring(root), "x", PLAIN)
    assert (header.instance, header.next) == ("7", 9)
    assert len(found) == sum(item != "z" for item, *_ in rows)
    for one in found:
        assert isinstance(one.value, str) or np.isnan(one.value) or np.isfinite(one.value)
    wanted = [item for item, *_ in sorted((r for r in rows if r[0] != "z"), key=lambda r: r[3])]
    assert [one.name[0] for one in found] == wanted
