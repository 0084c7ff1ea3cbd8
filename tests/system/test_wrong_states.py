"""Impossible, old and mangled states from a real RTDE connection: zero, a line, and back again."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from rtde_proxy import (
    Replay,
    RtdeProxy,
    Spoil,
    cut,
    filled,
    first_joint,
    flipped,
    twice,
    variable,
    wild_registers,
    wild_stamps,
    withheld,
)
from served_robot import (
    Server,
    applied_um,
    end_what_is_left,
    events,
    promote,
    wait_until_corrected,
    wait_until_released,
)
from virtual_robot import VirtualRobot, virtual_robot

from dtwin.config import Home
from dtwin.config import home as dtwin_home

pytestmark = pytest.mark.system
CLAMP_UM = 40.0
ATTACK_S = 1.5


@pytest.fixture(autouse=True)
def _nothing_left() -> Iterator[None]:
    yield
    end_what_is_left()


@pytest.fixture
def home() -> Home:
    return dtwin_home()


@pytest.fixture(scope="module")
def robot() -> Iterator[VirtualRobot]:
    with virtual_robot("--radius-mm=300", "--feed-mm-min=1000") as running:
        yield running


def largest_received_um(robot: VirtualRobot, path: Path) -> float:
    robot.do("offset_log", path=str(path))
    with np.load(path) as log:
        received = log["received_um"]
    assert np.isfinite(received).all()
    return float(np.linalg.norm(received, axis=1).max())


def reasons(home: Home) -> set[str]:
    return {line["why"] for line in events(home) if line["event"] == "guard"}


@pytest.mark.parametrize(
    ("spoil", "why"),
    [
        (filled(math.nan), "impossible_state"),
        pytest.param(filled(1e200), "impossible_state", marks=pytest.mark.long),
        pytest.param(variable("actual_TCP_pose", math.inf), "impossible_state", marks=pytest.mark.long),
        pytest.param(variable("target_TCP_pose", 5.0), "impossible_state", marks=pytest.mark.long),
        pytest.param(variable("actual_qd", 50.0), "impossible_state", marks=pytest.mark.long),
        pytest.param(first_joint(math.nan), "impossible_state", marks=pytest.mark.long),
        pytest.param(variable("timestamp", math.nan), "impossible_state", marks=pytest.mark.long),
        # From the second state on it also stands still.
        pytest.param(variable("timestamp", 1e300), "stale", marks=pytest.mark.long),
        pytest.param(variable("timestamp", 17.0), "stale", marks=pytest.mark.long),
        (wild_stamps(), "clock_jump"),
        (Replay(1.0, on=True), "stale"),
        pytest.param(Replay(1.0, on=False), "stale", marks=pytest.mark.long),
        (withheld, "stale"),
    ],
    ids=[
        "all nan",
        "all 1e200",
        "tcp inf",
        "tcp out of reach",
        "joints too fast",
        "one joint nan",
        "stamp nan",
        "stamp huge",
        "stamp stands",
        "stamps wild",
        "replay",
        "replay of kept ones",
        "withheld",
    ],
)
def test_what_is_no_state_of_now_leads_to_zero_and_costs_few_lines(
    robot: VirtualRobot, home: Home, tmp_path: Path, spoil: Spoil, why: str
) -> None:
    promote(home)
    with RtdeProxy(robot.host) as proxy:
        server = Server("--json", f"--host={proxy.host}", "--patience=60")
        if isinstance(spoil, Replay) and not spoil.on:
            proxy.spoil = spoil
            time.sleep(2.0 * spoil.age_s)
        wait_until_corrected(robot)
        if isinstance(spoil, Replay):
            spoil.on = True
        proxy.spoil = spoil
        wait_until_released(robot)
        until_s = time.monotonic() + ATTACK_S
        while time.monotonic() < until_s:
            assert applied_um(robot) < 0.5
            time.sleep(0.02)
        assert why in reasons(home)
        proxy.spoil = None
        wait_until_corrected(robot)
        server.interrupt()
        server.end()
    assert largest_received_um(robot, tmp_path / "log.npz") <= CLAMP_UM + 1e-9
    assert len(events(home)) < 60


@pytest.mark.parametrize(
    "spoil", [pytest.param(twice, id="twice", marks=pytest.mark.long), pytest.param(wild_registers(), id="registers")]
)
def test_what_may_be_a_state_never_leaves_the_clamp(
    robot: VirtualRobot, home: Home, tmp_path: Path, spoil: Spoil
) -> None:
    promote(home)
    with RtdeProxy(robot.host) as proxy:
        server = Server("--json", f"--host={proxy.host}", "--patience=60")
        wait_until_corrected(robot)
        proxy.spoil = spoil
        time.sleep(ATTACK_S)
        proxy.spoil = None
        wait_until_corrected(robot)
        server.interrupt()
        server.end()
    assert largest_received_um(robot, tmp_path / "log.npz") <= CLAMP_UM + 1e-9
    assert len(events(home)) < 60


@pytest.mark.parametrize(
    "raw", [pytest.param(flipped(), id="bits"), pytest.param(cut, id="cut", marks=pytest.mark.long)]
)
def test_packets_that_are_mangled_end_in_zero_one_way_or_the_other(
    robot: VirtualRobot, home: Home, tmp_path: Path, raw: object
) -> None:
    promote(home)
    with RtdeProxy(robot.host) as proxy:
        server = Server("--json", f"--host={proxy.host}")
        wait_until_corrected(robot)
        proxy.raw = raw  # type: ignore[assignment]
        code, _, err = server.end()
    assert code == 4, err
    assert "Traceback" not in err
    wait_until_released(robot)
    assert largest_received_um(robot, tmp_path / "log.npz") <= CLAMP_UM + 1e-9
