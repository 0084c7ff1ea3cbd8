"""States and offsets of machine axes over a real connection: what is agreed, what arrives, what fails."""

from __future__ import annotations

import json
import math
import socket
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from axis_control import AxisControl
from typer.testing import CliRunner

from dtwin.cli import app
from dtwin.config import Home
from dtwin.errors import DeviceError, GateRefusal, InputError
from dtwin.features.tone_window import COMMAND_AMPLITUDE, COMMAND_PHASE, COMMANDED, tone_contract
from dtwin.links import layout
from dtwin.links.axis_link import AxisLink
from dtwin.links.layout import LiveValues
from dtwin.links.virtual_key import proof
from dtwin.machines.axis_server import _WATCHDOG_S, AxisServer
from dtwin.schema import Floats
from dtwin.serve.builder import GraphBuilder
from dtwin.serve.bundle import Bundle
from dtwin.serve.bundle_file import create_bundle, save_bundle
from dtwin.serve.interface import Input, Output, Provenance, SafetyLimits
from dtwin.serve.pointer import machine_folder, write_pointer
from dtwin.serve.serve_request import Served, ServeRequest
from dtwin.serve.session import serve

pytestmark = pytest.mark.system

PERIOD_S = 0.01
PER_MM, PER_C = 2.0, 0.5


class Sledge:
    """An axis that goes to and fro, with a temperature every tenth tick until it breaks off."""

    name, period_s, axes = "sledge", PERIOD_S, ("z",)
    provides, channels_hz = ("z_mm", "bed_c"), 0.0

    def __init__(self, ticks: int, silent: range = range(0)) -> None:
        self.ticks, self.silent = ticks, silent
        self.offset_um = np.zeros((ticks, 3))

    def z_mm(self, tick: int) -> float:
        return 5.0 * math.sin(0.05 * tick)

    def state(self, tick: int) -> Mapping[str, float]:
        found = {"z_mm": self.z_mm(tick)}
        if tick % 10 == 0 and tick not in self.silent:
            found["bed_c"] = 22.0
        return found

    def advance(self, tick: int, offset_um: Floats) -> None:
        self.offset_um[tick] = offset_um

    def wanted_um(self) -> Floats:
        z = np.array([self.z_mm(tick) for tick in range(self.ticks)])
        return -(PER_MM * z + PER_C * 2.0)


def bundle(evidence: str = "virtual", trips_to_latch: int = 5) -> Bundle:
    builder = GraphBuilder()
    graph = builder.graph({"error_z_um": builder.input("z_mm") * PER_MM + (builder.input("bed_c") - 20.0) * PER_C})
    rates = {"z_mm": (1.0 / PERIOD_S, "mm"), "bed_c": (0.1 / PERIOD_S, "degC")}
    return create_bundle(
        name="sledge",
        machine="sledge",
        model_version=1,
        inputs=tuple(
            Input(name, unit, "none", rate, "controller", -100.0, 100.0) for name, (rate, unit) in rates.items()
        ),
        outputs=(Output("error_z_um", "base_z"),),
        tick_graph=graph,
        safety=SafetyLimits(clamp_um=50.0, slew_um_s=1e8, stale_s=0.5, trips_to_latch=trips_to_latch),
        provenance=Provenance(evidence=evidence),
    )


@pytest.fixture
def home(tmp_path: Path) -> Home:
    found = Home(tmp_path / "home")
    folder = machine_folder("sledge", found)
    folder.mkdir(parents=True)
    path = save_bundle(bundle(), folder / "v0001.json")
    write_pointer("sledge", found, path, 1, "champion")
    return found


def served(home: Home, address: str, **changes: object) -> Served:
    request = ServeRequest(axes=address, priority=0, **changes)  # type: ignore[arg-type]
    return serve(request, home, lambda line: None)


def test_every_state_gets_its_own_correction_on_the_machine_clock(home: Home) -> None:
    sledge = Sledge(400)
    with AxisControl(sledge, home) as control:
        found = served(home, control.address)
    status = found.status
    assert (status.ended, status.released, status.fault) == ("finished", True, None)
    assert (found.device, status.clock, found.exit_code) == ("virtual", "machine", 0)
    np.testing.assert_allclose(sledge.offset_um[1:, 2], sledge.wanted_um()[1:], atol=1e-9)
    assert not sledge.offset_um[:, :2].any()
    assert status.timing["missed_states"] == 0


def test_on_the_machine_clock_a_state_that_is_played_back_counts_for_nothing(home: Home) -> None:
    class Stuck(Sledge):
        def state(self, tick: int) -> Mapping[str, float]:
            # Of tick 50 until 99, of a second before until 149.
            played = {50: 50, 100: tick - 100}.get(tick // 50 * 50, tick) if tick < 150 else tick
            return {**super().state(played), "timestamp_s": played * PERIOD_S}

    sledge = Stuck(250)
    with AxisControl(sledge, home) as control:
        found = served(home, control.address)
    assert found.status.ended == "finished"
    assert sledge.offset_um[40:50, 2].all()
    assert not sledge.offset_um[55:149, 2].any()
    np.testing.assert_allclose(sledge.offset_um[200:, 2], sledge.wanted_um()[200:], atol=1e-9)


@pytest.mark.parametrize("mode", ["shadow", "dry-run"])
def test_who_only_looks_moves_nothing(home: Home, mode: str) -> None:
    sledge = Sledge(100)
    with AxisControl(sledge, home) as control:
        found = served(home, control.address, mode=mode)
    assert not sledge.offset_um.any()
    assert found.status.largest_um > 5.0


def test_a_value_that_is_not_renewed_releases_and_a_new_one_engages(home: Home) -> None:
    sledge = Sledge(400, silent=range(100, 200))
    with AxisControl(sledge, home) as control:
        found = served(home, control.address)
    # Good for three periods of a tenth of a second after tick 90.
    assert sledge.offset_um[100:119, 2].all()
    assert not sledge.offset_um[125:200].any()
    np.testing.assert_allclose(sledge.offset_um[202:, 2], sledge.wanted_um()[202:], atol=1e-9)
    assert found.status.reasons["not_finite"] == 79


def test_a_control_that_lacks_an_input_is_refused(home: Home) -> None:
    class Bare(Sledge):
        provides = ("z_mm",)

    control = AxisControl(Bare(10), home)
    threading.Thread(target=control._run, daemon=True).start()
    with pytest.raises(InputError, match="does not provide") as refused:
        served(home, control.address)
    assert refused.value.got == "without bed_c"
    control.server.close()


def test_a_control_that_proves_nothing_counts_as_real(home: Home, tmp_path: Path) -> None:
    control = AxisControl(Sledge(10), Home(tmp_path / "somebody-else"))
    threading.Thread(target=control._run, daemon=True).start()
    with pytest.raises(GateRefusal, match="never shown to help a real machine"):
        served(home, control.address)
    control.server.close()


def test_a_robot_s_link_is_told_what_is_missing(home: Home) -> None:
    with pytest.raises(InputError, match="only the machine's control can send") as refused:
        serve(ServeRequest(priority=0), home, lambda line: None)
    assert "--link axes" in refused.value.hint


def link_to(control: AxisControl) -> AxisLink:
    return AxisLink(control.address, LiveValues({"z_mm": 100.0}), ("z",))


def test_one_client_at_a_time(home: Home) -> None:
    control = AxisControl(Sledge(50), home, "wall")
    with control, link_to(control):
        with pytest.raises(DeviceError, match="the control refuses") as refused:
            link_to(control).open()
        assert refused.value.got == "another client corrects this control"


def test_on_the_wall_clock_the_control_lets_go_by_itself(home: Home) -> None:
    sledge = Sledge(150)
    control = AxisControl(sledge, home, "wall")
    with control:
        link = link_to(control)
        link.open()
        link.wait_state(1.0)
        link.send(np.array([0.0, 0.0, 7.0]), 1)
        until_s = time.monotonic() + 0.5
        while time.monotonic() < until_s:
            link.wait_state(0.02)
        assert control.server.watchdog_trips == 1
        assert link.newest[layout.APPLIED_SEQUENCE] == 0.0
        # What was dropped comes back only from zero.
        link.send(np.array([0.0, 0.0, 9.0]), 2)
        link.wait_state(0.05)
        link.send(np.zeros(3), 3)
        link.send(np.array([3.0, 0.0, 8.0]), 4)
        while link.newest[layout.APPLIED_SEQUENCE] != 4.0:
            link.wait_state(0.02)
        # A client that goes without a word.
        link.close()
    held = sledge.offset_um[:, 2]
    in_force = np.flatnonzero(held == 7.0)
    assert 1 <= len(in_force) <= round(_WATCHDOG_S / PERIOD_S) + 3
    assert (held == 8.0).any()
    assert not (held == 9.0).any()
    assert not held[-5:].any()
    assert not sledge.offset_um[:, 0].any(), "an axis that takes no offset was moved"


def test_a_served_control_on_the_wall_clock(home: Home) -> None:
    # A busy host keeps the loop away for most of the program: the guard never latches here, and what is
    # not enough is tried again for twice as long.
    path = save_bundle(bundle(trips_to_latch=1_000_000), machine_folder("sledge", home) / "v0001.json")
    write_pointer("sledge", home, path, 1, "champion")
    for ticks in (200, 400, 800, 1600, 3200):
        sledge = Sledge(ticks)
        with AxisControl(sledge, home, "wall") as control:
            found = served(home, control.address)
        assert (found.status.ended, found.status.clock) == ("finished", "wall")
        assert found.status.released
        wanted, sent = sledge.wanted_um(), sledge.offset_um[:, 2]
        # However busy it is: what is in force was right for a state that had been sent before.
        exact = [np.isclose(sent[k], wanted[:k]).any() for k in range(20, ticks) if sent[k]]
        if len(exact) > 20:
            break
    assert len(exact) > 20
    assert np.mean(exact) > 0.9


@pytest.mark.parametrize(("clock", "patience_s"), [("machine", 0.0), ("wall", 60.0)])
def test_a_control_that_breaks_off_is_a_fault_and_said(home: Home, clock: str, patience_s: float) -> None:
    """Also where it comes back without what the model needs."""
    listener = socket.create_server(("127.0.0.1", 0))

    def breaks_off(missing: Sequence[str] = ()) -> None:
        connection, _ = listener.accept()
        asked = json.loads(connection.recv(65536))
        state = {"timestamp_s": 0.0, "runtime_running": 1, "safety_ok": 1, "z_mm": 1.0, "bed_c": 20.0}
        greeting = {
            "dtwin": 1,
            "control": "x",
            "period_s": 0.01,
            "clock": clock,
            "watchdog_s": 0.1,
            "axes": ["z"],
            "missing": list(missing),
            "proof": "",
            "nonce": asked["nonce"],
        }
        connection.sendall(
            b"".join(json.dumps(part).encode() + b"\n" for part in (greeting, state))
            + b"garbage\n[1]\n"
            + json.dumps({**state, "z_mm": 1e400}).encode()
            + b"\n"
        )
        connection.settimeout(0.3)
        with suppress(TimeoutError):
            connection.recv(65536)
        connection.close()
        if not missing:
            breaks_off(["z_mm"])

    threading.Thread(target=breaks_off, daemon=True).start()
    found = served(home, f"127.0.0.1:{listener.getsockname()[1]}", mode="shadow", patience_s=patience_s)
    assert found.status.ended == "states.lost"
    assert (found.status.released, found.exit_code) == (clock == "wall", 4)
    listener.close()


@pytest.mark.parametrize(
    ("said", "told"),
    [
        (b"HTTP/1.1 400 Bad Request\r\n\r\n", "no axis link of this version"),
        (b'{"dtwin": 2}\n', "no axis link of this version"),
        (b'{"dtwin": 1, "period_s": -1}\n', "greeting cannot be used"),
        (b'{"dtwin": 1, "period_s": 5e-324}\n', "greeting cannot be used"),
        (b'{"dtwin": 1, "period_s": 0.01, "watchdog_s": 1, "clock": "sun"}\n', "greeting cannot be used"),
        (b'{"dtwin": 1, "refused": "busy"}\n', "the control refuses"),
        (b'{"refused": "busy"}\n', "the control refuses"),
    ],
)
def test_what_does_not_greet_is_no_control(said: bytes, told: str) -> None:
    listener = socket.create_server(("127.0.0.1", 0))

    def answers() -> None:
        connection, _ = listener.accept()
        connection.recv(65536)
        connection.sendall(said)
        time.sleep(0.2)
        connection.close()

    threading.Thread(target=answers, daemon=True).start()
    link = AxisLink(f"127.0.0.1:{listener.getsockname()[1]}", LiveValues({}), ("z",))
    with pytest.raises(DeviceError, match=told) as refused:
        link.open()
    # The bridge's author reads which word of it is wrong.
    assert refused.value.got
    assert refused.value.got.split()[-1] in said.decode()
    listener.close()


def test_nobody_there_and_no_address_are_said() -> None:
    with pytest.raises(InputError, match="no address"):
        AxisLink("somewhere", LiveValues({}), ("z",))
    with pytest.raises(DeviceError, match="no axis link answers"):
        AxisLink("127.0.0.1:9", LiveValues({}), ("z",)).open()


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--machine", "turning", "--listen", "0", "--wall-clock"], "cannot be corrected so"),
        (["--machine", "cobot", "--listen", "0"], "cannot be corrected so"),
        (["--machine", "lathe", "--wall-clock"], "real time is for a machine"),
        (["--machine", "lathe", "--listen", "70000"], "no such port"),
    ],
)
def test_what_cannot_listen_is_refused(words: list[str], told: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=told):
        CliRunner().invoke(app, ["simulate", *words, "--out", str(tmp_path / "out")], catch_exceptions=False)
    assert not (tmp_path / "out").exists()


def test_a_port_that_is_taken_is_said(home: Home) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = int(taken.getsockname()[1])
        with pytest.raises(DeviceError, match="cannot listen"):
            AxisServer(Sledge(1), lambda nonce: "", port=port)


def test_patience_waits_for_a_control_that_is_not_there_yet(home: Home) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = int(taken.getsockname()[1])
    sledge = Sledge(50)

    def later() -> None:
        time.sleep(0.5)
        server = AxisServer(sledge, lambda nonce: proof(home, nonce), port=port)
        server.run(lambda line: None, lambda done, total, what: None)
        server.close()

    threading.Thread(target=later, daemon=True).start()
    found = served(home, f"127.0.0.1:{port}", patience_s=20.0)
    assert found.status.ended == "finished"
    with pytest.raises(DeviceError, match="no axis link answers"):
        served(home, f"127.0.0.1:{port}")


def test_tones_are_not_corrected_over_a_network_in_real_time(home: Home, tmp_path: Path) -> None:
    contract = tone_contract(100.0, "tool_z_g")
    builder, window = GraphBuilder(), GraphBuilder()
    size, angle = (builder.input(name) for name in (COMMAND_AMPLITUDE, COMMAND_PHASE))
    wave = size * builder.apply("sin", angle) * builder.input("gain_1")
    tones = create_bundle(
        name="tones",
        machine="sledge",
        model_version=2,
        inputs=(
            Input(COMMAND_PHASE, "rad", "path", 100.0, "controller", -7.0, 7.0),
            Input(COMMAND_AMPLITUDE, "um", "path", 100.0, "controller", 0.0, 10.0),
            Input("tool_z_rms_g", "g", "sensor", 1.0, "feature", 0.0, 1.0),
        ),
        outputs=(Output("correction_z_um", "base_z", "correction"),),
        window=contract,
        window_graph=window.graph({"gain_1": window.input("tool_z_rms_g") * 1.0}),
        tick_graph=builder.graph({"correction_z_um": wave}),
        safety=SafetyLimits(),
        provenance=Provenance(evidence="virtual"),
    )
    path = save_bundle(tones, machine_folder("sledge", home) / "v0002.json")
    write_pointer("sledge", home, path, 2, "champion")

    class Tones(Sledge):
        provides = (COMMAND_PHASE, COMMAND_AMPLITUDE, COMMANDED, *contract.channels)
        channels_hz = 100.0

    control = AxisControl(Tones(10), home, "wall")
    with control, pytest.raises(InputError, match="in real time"):
        served(home, control.address)
