"""``dtwin serve --link analogue``: the loop, the real firmware in simavr, and a control's feed."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from control_feed import RATE_HZ, ControlFeed, SpoilingLine
from served_robot import Server, end_what_is_left, events, noted, promote, refused, wait_for
from simulated_analogue_board import AnalogueBoard

from dtwin.config import Home
from dtwin.config import home as dtwin_home
from dtwin.links.analogue import AnalogueOutput
from dtwin.links.analogue_calibration import _AxisFit, save
from dtwin.serve.builder import GraphBuilder
from dtwin.serve.interface import Input, Output, Provenance, SafetyLimits

pytest_plugins = ["simulated_board"]
pytestmark = pytest.mark.system
NEUTRAL_V = (5.0, 5.0, 5.0)
UM_PER_V = 25.0
CLOCK_HZ = 16e6


@pytest.fixture
def board(programs: Path, tmp_path: Path) -> Iterator[AnalogueBoard]:
    for program in programs.iterdir():
        shutil.copy2(program, tmp_path)
    with AnalogueBoard(tmp_path) as running:
        yield running


@pytest.fixture
def feed() -> Iterator[ControlFeed]:
    with ControlFeed() as running:
        yield running


@pytest.fixture(autouse=True)
def _nothing_left() -> Iterator[None]:
    yield
    end_what_is_left()


@pytest.fixture
def home() -> Home:
    return dtwin_home()


@pytest.fixture
def calibration(tmp_path: Path) -> Path:
    path = tmp_path / "analogue.json"
    save(path, {axis: _AxisFit(UM_PER_V, 5.0, 0.01, 0.001, 0.05, {}, 5) for axis in "xyz"})
    return path


def serve(board_port: str, feed: ControlFeed, calibration: Path, *options: str) -> Server:
    return Server(
        "--json",
        "--link=analogue",
        f"--port={board_port}",
        f"--states={feed.address}",
        f"--states-hz={RATE_HZ:g}",
        f"--calibration={calibration}",
        "--watchdog-ms=1000",
        *options,
    )


def real(home: Home, **changes: Any) -> None:
    """A champion that a real machine has earned: a serial port is never taken for virtual."""
    promote(home, provenance=Provenance(evidence="real"), **changes)


def radius_um(board: AnalogueBoard) -> float:
    x, y, _ = board.volts()
    return float(np.hypot(x - 5.0, y - 5.0)) * UM_PER_V


def wait_until_corrected(board: AnalogueBoard) -> None:
    wait_for(lambda: radius_um(board) > 23.5, "never corrected")


def is_corrected_or_ended(board: AnalogueBoard, server: Server) -> bool:
    return radius_um(board) > 23.5 or server.process.poll() is not None


def corrected(
    board: AnalogueBoard, feed: ControlFeed, calibration: Path, *options: str, port: str | None = None
) -> Server:
    """Serve until the board is corrected: a computer that lets the loop wait for a second trips it, rightly."""
    for _ in range(5):
        server = serve(port or board.port, feed, calibration, *options)
        try:
            wait_for(partial(is_corrected_or_ended, board, server), "never corrected")
        except AssertionError as error:
            server.process.kill()
            raise AssertionError(f"{server.end()}\n{events(dtwin_home())}") from error
        if server.process.poll() is None:
            return server
        told = server.end()
    raise AssertionError(told)


def test_a_served_radial_correction_turns_with_the_path(
    board: AnalogueBoard, feed: ControlFeed, home: Home, calibration: Path
) -> None:
    real(home)
    # A computer that lets the loop wait for a second trips the board, rightly.
    for _ in range(5):
        server = corrected(board, feed, calibration)
        seen = []
        for _ in range(40):
            seen.append(board.volts())
            time.sleep(0.05)
        server.interrupt()
        code, out, err = server.end()
        status = json.loads(out)
        if status["ended"] != "analogue.tripped":
            break
    assert (code, status["ended"], status["released"]) == (0, "stopped", True), err
    assert (status["device"], status["host"]) == ("real", board.port)
    volts = np.array(seen) - 5.0
    length_um = np.hypot(volts[:, 0], volts[:, 1]) * UM_PER_V
    assert np.median(length_um) == pytest.approx(24.0, abs=1.0)
    # On a busy computer a late state takes it back for moments; it is never larger.
    assert length_um.max() < 25.0
    assert np.quantile(length_um, 0.2) == pytest.approx(24.0, abs=1.0)
    assert not volts[:, 2].any()
    # A vector that turns, not one number on two axes.
    assert np.ptp(np.unwrap(np.arctan2(volts[:, 1], volts[:, 0]))) > 0.5
    assert board.wait_for(NEUTRAL_V)


def test_a_killed_loop_is_neutral_by_the_board_s_own_watchdog(
    board: AnalogueBoard, feed: ControlFeed, home: Home, calibration: Path
) -> None:
    real(home)
    server = corrected(board, feed, calibration)
    server.process.kill()
    server.end()
    assert board.wait_for(NEUTRAL_V)
    # By the board's own clock, from the last correction to neutral.
    last, neutral = board.changes[-2:]
    assert 1.000 <= (neutral - last) / CLOCK_HZ <= 1.010
    wait_for(lambda: bool(noted(home, "killed")), "no word of the death")
    with AnalogueOutput(board.port) as output:
        assert output.status().trips >= 1


def test_a_feed_that_ends_releases_and_one_that_returns_is_taken_up_from_zero(
    board: AnalogueBoard, home: Home, calibration: Path
) -> None:
    real(home)
    with ControlFeed() as feed:
        server = corrected(board, feed, calibration, "--patience=60")
        feed.garbage = b'{"timestamp_s": NaN, "half'
        wait_for(lambda: radius_um(board) == 0.0, "garbage held the correction")
        feed.garbage = b""
        wait_until_corrected(board)
        feed.changes = {"runtime_running": -1.0}
        wait_for(lambda: radius_um(board) == 0.0, "a pause held the correction")
        feed.changes = {}
        wait_until_corrected(board)
        port = feed.port
    assert board.wait_for(NEUTRAL_V)
    with ControlFeed(port) as again:
        wait_until_corrected(board)
        # Half open: the connection stands, and nothing comes.
        again.silent = True
        assert board.wait_for(NEUTRAL_V)
        wait_for(lambda: len(noted(home, "link_lost")) == 2, "silence was no fault")
        again.silent = False
        wait_until_corrected(board)
        server.interrupt()
        code, out, _ = server.end()
    assert (code, json.loads(out)["reconnects"]) == (0, 2)
    assert [line["why"] for line in noted(home, "link_lost")] == ["states.lost", "states.silent"]
    assert board.wait_for(NEUTRAL_V)


def test_garbage_and_cut_frames_never_become_a_voltage(
    board: AnalogueBoard, feed: ControlFeed, home: Home, calibration: Path
) -> None:
    real(home)
    rng = np.random.default_rng(2)
    # A computer that lets the loop wait for a second trips the board, rightly.
    for _ in range(5):
        with SpoilingLine(board.port) as line:
            server = corrected(board, feed, calibration, "--patience=60", port=line.port)
            for spoil in range(30):
                if spoil % 2:
                    line.cut = int(rng.integers(1, 12))
                else:
                    line.invent = bytes(rng.integers(0, 256, 30, dtype=np.uint8))
                time.sleep(0.05)
                assert radius_um(board) < 24.5
            wait_for(partial(is_corrected_or_ended, board, server), "never corrected")
            server.interrupt()
            code, out, err = server.end()
            assert board.wait_for(NEUTRAL_V)
        status = json.loads(out)
        if status["ended"] != "analogue.tripped":
            break
    assert (code, status["ended"]) == (0, "stopped"), err


def test_beyond_the_travel_and_outside_the_box(
    board: AnalogueBoard, feed: ControlFeed, home: Home, calibration: Path
) -> None:
    g = GraphBuilder()
    feed.changes = {"feed_mm_min": 2000.0}
    real(
        home,
        inputs=[Input("programmed_feed_mm_min", "mm/min", "path", 500.0, "path", 0.0, 4000.0)],
        outputs=[Output("z_um", "base_z", "correction")],
        tick_graph=g.graph({"z_um": 0.1 * g.input("programmed_feed_mm_min")}),
        safety=SafetyLimits(clamp_um=300.0, stale_s=0.3, trips_to_latch=9),
    )
    server = serve(board.port, feed, calibration)
    # 200 um are asked for, 300 um would be allowed, 125 um can be reached.
    assert board.wait_for((5.0, 5.0, 9.99985), timeout_s=30.0)
    feed.changes = {"feed_mm_min": 5000.0}
    assert board.wait_for(NEUTRAL_V)
    wait_for(lambda: noted(home, "guard")[-1]["why"] == "outside_box", "the box was not named")
    server.interrupt()
    code, out, _ = server.end()
    status = json.loads(out)
    assert (code, status["clamp_um"]) == (0, 125.0)
    assert status["reasons"]["clamped"] > 0


@pytest.mark.parametrize(
    ("options", "error", "code"),
    [
        (("--link=analogue",), "serve.link", 1),
        (("--link=serial",), "serve.link", 1),
        (("--link=analogue", "--port=/dev/null", "--states=nowhere"), "serve.evidence", 3),
        (("--link=analogue", "--port=/dev/null", "--states=nowhere", "--trial"), "analogue.uncalibrated", 1),
        (("--link=analogue", "--port=/dev/null", "--states=nowhere", "--shadow"), "states.address", 1),
        (("--link=analogue", "--port=/dev/null", "--states=127.0.0.1:1", "--dry-run"), "states.absent", 4),
    ],
)
def test_what_cannot_be_served_is_said(options: tuple[str, ...], error: str, code: int, home: Home) -> None:
    promote(home)
    found, answer = refused(*options)
    assert (found, answer["error"]["code"]) == (code, error), answer
