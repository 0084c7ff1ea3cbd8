"""``dtwin serve`` as a user runs it, with the real ur-rtde client, against the virtual robot."""

from __future__ import annotations

import dataclasses
import fcntl
import json
import os
import pty
import signal
import socket
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from command_here import command_here
from served_robot import (
    MACHINE,
    Server,
    bundle,
    end_what_is_left,
    logged,
    promote,
    refused,
    served,
    wait_until_corrected,
    wait_until_released,
)
from typer.testing import CliRunner
from virtual_robot import RTDE_PORT, VirtualRobot, free_address, virtual_robot

from dtwin.commands import _serving as serving
from dtwin.config import Home
from dtwin.config import home as dtwin_home
from dtwin.errors import DtwinError, GateRefusal
from dtwin.features.windows import WindowContract
from dtwin.serve._connection import _require_evidence
from dtwin.serve.band import COVARIANCE, constant_band
from dtwin.serve.builder import GraphBuilder
from dtwin.serve.bundle_file import save_bundle
from dtwin.serve.controller_kind import is_virtual
from dtwin.serve.interface import Input, Provenance, SafetyLimits
from dtwin.serve.pointer import machine_folder, write_pointer
from dtwin.serve.serve_request import ServeRequest
from dtwin.serve.session import serve

pytestmark = pytest.mark.system


@pytest.fixture(autouse=True)
def _nothing_left() -> Iterator[None]:
    yield
    end_what_is_left()


@pytest.fixture
def home() -> Home:
    return dtwin_home()


@pytest.fixture(scope="module")
def robot() -> Iterator[VirtualRobot]:
    with virtual_robot("--feed-mm-min=3000") as running:
        yield running


@pytest.fixture
def own_robot() -> Iterator[VirtualRobot]:
    with virtual_robot("--feed-mm-min=3000") as running:
        yield running


def test_serves_for_the_time_that_was_asked_for(robot: VirtualRobot, home: Home) -> None:
    promote(home)
    code, out, err = Server("--json", f"--host={robot.host}", "--duration=2").end()
    status = json.loads(out)
    assert code == 0
    assert (status["ended"], status["released"], status["fault"]) == ("duration", True, None)
    assert (status["machine"], status["device"], status["mode"]) == (MACHINE, "virtual", "live")
    assert status["model"]["version"] == 3
    assert status["largest_um"] == pytest.approx(24.0)
    assert status["timing"]["ticks"] > 100
    assert status["reasons"]["ok"] > 50
    assert "latest is cobot-a: version 3 (champion)" in err
    wait_until_released(robot)
    (line,) = logged(home)
    assert (line["model"]["version"], line["ended"]) == (3, "duration")
    assert line["timing"]["ticks"] == status["timing"]["ticks"]


def test_text_for_people_names_what_matters(robot: VirtualRobot, home: Home) -> None:
    promote(home)
    code, out, err = command_here("serve", "--priority=0", f"--host={robot.host}", "--duration=1")
    assert code == 0, err
    for words in (
        "virtual controller",
        "equation",
        "guard",
        "state to correction",
        "real-time",
        "jitter",
        "##",
        "priority not asked for",
        "garbage collection used",
    ):
        assert words in out
    assert "sensor window age" not in out


@pytest.mark.parametrize(("options", "expected"), [((), 0), (("--duration=300",), 130)])
def test_interrupt_releases(robot: VirtualRobot, home: Home, options: tuple[str, ...], expected: int) -> None:
    promote(home)
    server = Server("--json", f"--host={robot.host}", *options)
    wait_until_corrected(robot)
    server.interrupt()
    code, out, _ = server.end()
    status = json.loads(out)
    assert (code, status["ended"], status["released"]) == (expected, "stopped", True)
    wait_until_released(robot)


def test_a_closed_terminal_releases(robot: VirtualRobot, home: Home) -> None:
    """As a connection to the serving computer that drops: its terminal hangs up, and takes no more text."""
    promote(home)
    master, terminal = pty.openpty()
    command = [sys.executable, "-m", "dtwin", "serve", "--priority=0", f"--host={robot.host}"]

    def own() -> None:
        fcntl.ioctl(0, termios.TIOCSCTTY, 0)
        # Tests that nohup began would have it ignored here, too.
        signal.signal(signal.SIGHUP, signal.SIG_DFL)

    server = subprocess.Popen(
        command, stdin=terminal, stdout=terminal, stderr=terminal, start_new_session=True, preexec_fn=own
    )
    os.close(terminal)
    try:
        wait_until_corrected(robot)
        os.close(master)
        server.wait(300)
    finally:
        server.kill()
        server.wait()
    wait_until_released(robot)
    (session,) = logged(home)
    assert (session["ended"], session["released"]) == ("stopped", True)


def test_killed_server_is_released_by_the_robot(robot: VirtualRobot, home: Home) -> None:
    promote(home)
    server = Server(f"--host={robot.host}")
    wait_until_corrected(robot)
    server.process.kill()
    server.end()
    wait_until_released(robot)
    assert served(f"--host={robot.host}", "--duration=1")[0] == 0


def test_absent_controller(home: Home) -> None:
    promote(home)
    address = free_address()
    code, answer, _ = served(f"--host={address}", "--duration=1")
    assert (code, answer["error"]["code"]) == (4, "ur.absent")
    assert address in answer["error"]["where"]
    assert logged(home)[0]["ended"] == "ur.absent"


def test_dropped_link(robot: VirtualRobot, home: Home) -> None:
    promote(home)
    server = Server(f"--host={robot.host}")
    wait_until_corrected(robot)
    robot.do("drop")
    code, out, err = server.end()
    assert code == 4
    assert "error[ur." in err
    assert "Traceback" not in err
    assert "ended: ur." in out
    wait_until_released(robot)


def test_stall_of_a_second_is_released_and_survived(robot: VirtualRobot, home: Home) -> None:
    promote(home)
    server = Server("--json", f"--host={robot.host}")
    wait_until_corrected(robot)
    robot.do("stall", seconds=1.0)
    wait_until_released(robot)
    wait_until_corrected(robot)
    server.interrupt()
    code, out, _ = server.end()
    status = json.loads(out)
    assert (code, status["released"]) == (0, True)
    assert status["reasons"]["stale"] > 0
    assert status["timing"]["timeouts"] > 0


def test_speed_slider_does_not_end_the_serving(own_robot: VirtualRobot, home: Home) -> None:
    promote(home)
    server = Server("--json", f"--host={own_robot.host}")
    wait_until_corrected(own_robot)
    own_robot.do("speed", factor=0.5)
    before = own_robot.do("status")["ticks"]
    while own_robot.do("status")["ticks"] < before + 250:
        time.sleep(0.02)
    # A busy test computer may make the loop release in between; it goes on by itself.
    wait_until_corrected(own_robot)
    server.interrupt()
    code, out, _ = server.end()
    assert (code, json.loads(out)["released"]) == (0, True)


def test_protective_stop_ends_the_serving(own_robot: VirtualRobot, home: Home) -> None:
    promote(home)
    server = Server("--json", f"--host={own_robot.host}")
    wait_until_corrected(own_robot)
    own_robot.do("protective_stop")
    code, out, err = server.end()
    status = json.loads(out)
    assert (code, status["ended"], status["released"]) == (4, "safety_stop", True)
    assert "error[serve.safety_stop]" in err
    wait_until_released(own_robot)


def test_repeated_faults_latch_and_end_the_serving(own_robot: VirtualRobot, home: Home) -> None:
    safety = SafetyLimits(clamp_um=40.0, slew_um_s=2000.0, stale_s=0.3, trips_to_latch=1)
    promote(home, safety=safety)
    server = Server("--json", f"--host={own_robot.host}")
    wait_until_corrected(own_robot)
    own_robot.do("stall", seconds=0.8)
    code, out, _ = server.end()
    status = json.loads(out)
    assert (code, status["ended"]) == (4, "latched")
    assert status["fault"]["code"] == "serve.latched"
    wait_until_released(own_robot)


@pytest.mark.parametrize("how", ["bundle", "pointer"])
def test_tampered_bundle(robot: VirtualRobot, home: Home, how: str) -> None:
    path = promote(home)
    plain = path.read_text().replace("24.0", "39.0")
    assert plain != path.read_text()
    path.write_text(plain)
    if how == "pointer":
        write_pointer(MACHINE, home, path, 3, "champion")
    code, answer = refused(f"--host={robot.host}", "--duration=1")
    assert (code, answer["error"]["code"]) == ((3, "pointer.checksum") if how == "bundle" else (1, "bundle.checksum"))


def test_a_champion_whose_evidence_has_expired(robot: VirtualRobot, home: Home) -> None:
    promote(home, provenance=Provenance(evidence="virtual", valid_days=30.0))
    code, answer = refused(f"--host={robot.host}", "--duration=1")
    assert (code, answer["error"]["code"]) == (3, "serve.expired")
    code, _, err = served(f"--host={robot.host}", "--duration=0.5", "--expired=warn")
    assert code == 0
    assert "WARNING: the evidence has expired" in err
    code, _, err = served(f"--host={robot.host}", "--duration=0.5", "--shadow")
    assert (code, "expired" in err) == (0, False)
    code, answer = refused(f"--host={robot.host}", "--expired=ignore")
    assert (code, answer["error"]["code"]) == (1, "serve.expired_option")


def test_a_small_correction_fades_unless_told_otherwise(robot: VirtualRobot, home: Home) -> None:
    promote(home, band=constant_band({"radial_error_um": 48.0}, COVARIANCE))
    _, by_default, said = served(f"--host={robot.host}", "--duration=1")
    assert "(k = 2, from covariance): what is smaller than that fades out" in said
    assert (by_default["band"], by_default["fades"]) == ("covariance", True)
    assert by_default["largest_band_um"] == pytest.approx(48.0)
    # Half of its half width: half is left.
    assert by_default["largest_um"] == pytest.approx(12.0, rel=0.01)
    _, whole, said = served(f"--host={robot.host}", "--duration=1", "--no-fade")
    assert "nothing fades out" in said
    assert whole["largest_um"] == pytest.approx(24.0, rel=0.01)
    promote(home)
    code, answer = refused(f"--host={robot.host}", "--duration=1", "--fade")
    assert code == 3
    assert "does not say how uncertain its correction is" in answer["error"]["message"]


def test_bundle_of_another_machine(robot: VirtualRobot, home: Home) -> None:
    promote(home, machine="cobot-b")
    code, answer, _ = served(f"--host={robot.host}", "--duration=1")
    assert (code, answer["error"]["code"]) == (3, "bundle.machine")


@pytest.mark.parametrize("state", ["withdrawn", "candidate"])
def test_version_that_did_not_pass(robot: VirtualRobot, home: Home, state: str) -> None:
    promote(home, state)
    code, answer = refused(f"--host={robot.host}", "--duration=1")
    assert (code, answer["error"]["code"], answer["error"]["got"]) == (3, "serve.not_passed", state)
    code, status, _ = served(f"--host={robot.host}", "--duration=0.5", "--shadow")
    assert (code, status["last_sequence"], status["model"]["state"]) == (0, 0, state)


def test_file_is_served_harmlessly_only(robot: VirtualRobot, home: Home, tmp_path: Path) -> None:
    promote(home)
    path = save_bundle(bundle(model_version=8), tmp_path / "draft.json")
    options = (f"--model={path}", f"--host={robot.host}", "--duration=1")
    code, answer = refused(*options)
    assert (code, answer["error"]["got"]) == (3, "unpromoted")
    code, status, _ = served(*options, "--dry-run")
    assert (code, status["mode"], status["model"]["state"]) == (0, "dry-run", "unpromoted")
    assert status["last_sequence"] > 50
    assert status["largest_um"] == pytest.approx(24.0)


def test_trial_has_a_tight_clamp(robot: VirtualRobot, home: Home) -> None:
    promote(home)
    promote(home, "trial", model_version=4)
    for model, options, version in (("trial", (), 4), ("latest", ("--trial",), 3)):
        code, status, err = served(f"--model={model}", f"--host={robot.host}", "--duration=1", *options)
        assert (code, status["model"]["version"], status["trial"]) == (0, version, True)
        assert status["clamp_um"] == 10.0
        assert status["largest_um"] == pytest.approx(10.0)
        assert status["reasons"]["clamped"] > 20
        assert "limited to 10.0 µm" in err


def test_two_servers_at_once(robot: VirtualRobot, home: Home) -> None:
    promote(home)
    first = Server("--json", f"--host={robot.host}")
    wait_until_corrected(robot)
    code, answer = refused(f"--host={robot.host}", "--duration=1")
    assert (code, answer["error"]["code"]) == (4, "serve.lease")
    assert str(first.process.pid) in answer["error"]["got"]
    code, status, _ = served(f"--host={robot.host}", "--duration=0.5", "--shadow")
    assert (code, status["last_sequence"]) == (0, 0)
    # The first one goes on; on a busy host it may have dropped to zero for a moment.
    wait_until_corrected(robot)
    first.interrupt()
    assert first.end()[0] == 0


def test_log_that_cannot_be_written_does_not_stop_the_serving(robot: VirtualRobot, home: Home) -> None:
    promote(home)
    home.logs.write_text("a file where the folder should be")
    code, status, err = served(f"--host={robot.host}", "--duration=1")
    assert (code, status["released"]) == (0, True)
    assert status["log"].startswith("not written")
    assert "not written" in err


def test_lease_that_cannot_be_taken_stops_it(robot: VirtualRobot, home: Home) -> None:
    promote(home)
    (home.root / "locks").write_text("a file where the folder should be")
    code, answer = refused(f"--host={robot.host}", "--duration=1")
    assert (code, answer["error"]["code"]) == (1, "serve.lease_file")


def test_unknown_machine_and_unknown_tool(robot: VirtualRobot, home: Home) -> None:
    code, answer = refused(f"--host={robot.host}")
    assert (code, answer["error"]["code"]) == (1, "serve.machine")
    promote(home)
    code, answer = refused(f"--host={robot.host}", "--duration=1", "--covariate=programmed_feed_mm_min=1")
    assert (code, answer["error"]["code"]) == (1, "serve.covariate")
    (machine_folder(MACHINE, home) / "machine.json").unlink()
    code, answer = refused(f"--host={robot.host}", "--duration=1")
    assert (code, answer["error"]["code"]) == (1, "serve.geometry")


@pytest.mark.parametrize(
    ("options", "error"),
    [
        (("--shadow", "--dry-run"), "serve.mode"),
        (("--duration=0",), "serve.duration"),
        (("--duration=nan",), "serve.duration"),
        (("--priority=100",), "serve.priority"),
        (("--covariate=warm",), "serve.covariate"),
        (("--model=newest",), "serve.model"),
    ],
)
def test_unusable_options(options: tuple[str, ...], error: str) -> None:
    result = CliRunner().invoke(serving.app, list(options))
    assert isinstance(result.exception, DtwinError)
    assert (result.exception.code, result.exception.exit_code) == (error, 1)


class Impostor:
    """A relay at a loopback address whose answers are those of a real controller."""

    def __init__(self, answer: bytes) -> None:
        self.host, self._answer = free_address(), answer
        self._listener = socket.create_server((self.host, RTDE_PORT))
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        connection, _ = self._listener.accept()
        with connection:
            for reply in (b"\x00\x04\x56\x01", b"\x00\x08\x4dhello", self._answer):
                connection.recv(4096)
                connection.sendall(reply)
                if reply[2] == 0x4D:
                    connection.sendall(self._answer)
                    return

    def close(self) -> None:
        self._listener.close()


@pytest.mark.parametrize(
    "answer", [b"\x00\x0d\x4f\x00NOT_FOUND", b"\x00\x04\x4f\x01", b"\x00\x01\x4f", b"\x00\x02", b""]
)
def test_whatever_does_not_prove_virtual_is_real(answer: bytes) -> None:
    impostor = Impostor(answer)
    assert not is_virtual(impostor.host, timeout_s=1.0)
    impostor.close()


def test_only_the_virtual_controller_is_virtual(robot: VirtualRobot) -> None:
    assert is_virtual(robot.host)
    assert not is_virtual(free_address())
    assert not is_virtual("192.0.2.1", timeout_s=0.1)


@pytest.mark.parametrize("evidence", ["none", "virtual"])
def test_real_device_wants_real_evidence(evidence: str) -> None:
    made = bundle(provenance=Provenance(evidence=evidence))
    with pytest.raises(GateRefusal, match="real machine") as refused:
        _require_evidence(made, "real", mode="live", trial=False)
    assert refused.value.exit_code == 3
    _require_evidence(made, "real", mode="live", trial=True)
    _require_evidence(made, "real", mode="shadow", trial=False)
    _require_evidence(made, "virtual", mode="live", trial=False)
    real = dataclasses.replace(made, provenance=Provenance(evidence="real"))
    _require_evidence(real, "real", mode="live", trial=False)


class PacedWindows:
    """Delivers one made window of a contract every 20 ms."""

    def __init__(self, contract: WindowContract) -> None:
        self.contract = contract
        self.closed = False
        self._block = 0.1 * np.random.default_rng(0).standard_normal((1, contract.n_samples))
        self._delivered_s = 0.0

    def newest_window(self) -> tuple[np.ndarray | None, float]:
        now_s = time.monotonic()
        if now_s - self._delivered_s < 0.02:
            return None, now_s - self._delivered_s
        self._delivered_s = now_s
        return self._block, 0.0

    def __enter__(self) -> PacedWindows:
        return self

    def __exit__(self, *_: object) -> None:
        self.closed = True


def test_sensors_are_opened_with_the_contract_and_closed(robot: VirtualRobot, home: Home) -> None:
    contract = WindowContract(1652.0, 150, 15, ("wrist_x_g",), ("rms",))
    g = GraphBuilder()
    promote(
        home,
        inputs=[Input("wrist_x_rms_g", "g", "sensor", 110.0, "feature", 0.0, 2.0)],
        window=contract,
        tick_graph=g.graph({"radial_error_um": 100.0 * g.input("wrist_x_rms_g")}),
    )
    request = ServeRequest(host=robot.host, duration_s=1.0, priority=0)
    with pytest.raises(DtwinError, match="sensor windows"):
        serve(request, home, lambda _: None)
    opened: list[PacedWindows] = []

    def open_sensors(wanted: WindowContract) -> PacedWindows:
        opened.append(PacedWindows(wanted))
        return opened[-1]

    served_now = serve(request, home, lambda _: None, open_sensors)
    assert [(s.contract, s.closed) for s in opened] == [(contract, True)]
    assert served_now.status.largest_um == pytest.approx(10.0, rel=0.3)
    assert served_now.status.timing["window_age_ms"]["max"] > 1.0
    assert "sensor window age" in serving._render_served(served_now)
