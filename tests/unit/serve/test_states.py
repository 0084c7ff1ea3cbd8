"""States that no machine can have, stamps that do not go on, and a journal that is not flooded."""

from __future__ import annotations

import numpy as np
import pytest

from dtwin.kinematics import UR10E
from dtwin.links import layout
from dtwin.links.layout import LiveValues
from dtwin.links.state_feed import _REQUIRED, StateFeed
from dtwin.machines.cobot import VirtualCobot
from dtwin.machines.motion import CircleCondition
from dtwin.serve import _state_limits as state_limits
from dtwin.serve._journal import Sparing
from dtwin.serve._timing import _SETTLE_S, StampWatch
from dtwin.serve.builder import GraphBuilder
from dtwin.serve.bundle_file import create_bundle
from dtwin.serve.decision import Decision
from dtwin.serve.interface import Input, Output, SafetyLimits, State
from dtwin.serve.runtime import CompiledBundle
from dtwin.serve.safety import IMPOSSIBLE

TCP_MM = np.array([0.0, 0.0, 158.3])
LARGEST = state_limits.robot(UR10E, TCP_MM)


def real_states() -> np.ndarray:
    controller = VirtualCobot(seed=3).controller(CircleCondition("YZ", 300.0, 6000.0, "CW"), setup="s1", repeat=1)
    states = []
    for _ in range(2000):
        states.append(controller.state().copy())
        controller.step(layout.correction_registers())
    return np.array(states)


def test_what_a_robot_does_is_possible_and_so_is_nothing() -> None:
    for state in [layout.empty_state(), *real_states()]:
        assert state_limits.possible(state, LARGEST)
        assert state_limits.possible(state, state_limits.any_machine())
        assert state_limits.impossible(state, LARGEST) == ""


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e200, -1e12])
@pytest.mark.parametrize("place", range(layout.N))
def test_no_number_of_a_state_may_be_impossible(place: int, bad: float) -> None:
    state = layout.empty_state()
    state[place] = bad
    for largest in (LARGEST, state_limits.any_machine()):
        assert not state_limits.possible(state, largest)
        assert state_limits.impossible(state, largest).startswith(layout.NAMES[place])


def test_a_line_with_a_number_of_no_float_is_no_state() -> None:
    whole = "{" + ", ".join(f'"{name}": 1' for name in _REQUIRED) + "}"
    feed = StateFeed("127.0.0.1:9")
    assert feed._read(whole.encode())
    for number in ("1" + "0" * 400, "1" + "0" * 5000, "NaN", "[1]", "null"):
        assert not feed._read(whole.replace("1", number, 1).encode())


@pytest.mark.parametrize(
    ("name", "value"), [("actual_tcp_x_mm", 2000.0), ("target_q_3_rad", 20.0), ("actual_qd_1_rad_s", 30.0)]
)
def test_a_robot_has_limits_of_its_own(name: str, value: float) -> None:
    state = layout.empty_state()
    state[layout.INDEX[name]] = value
    assert state_limits.possible(state, state_limits.any_machine())
    assert not state_limits.possible(state, LARGEST)


def test_an_impossible_state_leads_to_zero_and_leaves_no_trace() -> None:
    from bundles import path_bundle

    decision = Decision(CompiledBundle(path_bundle()), TCP_MM, largest=LARGEST)
    stages = np.zeros(6, dtype=np.int64)
    states = real_states()

    def tick(state: np.ndarray) -> float:
        out = decision.decide(state, age_s=0.0, elapsed_s=0.002, enabled=True, stages=stages)
        return float(np.linalg.norm(out))

    for state in states[:200]:
        before = tick(state)
    assert before > 1.0
    bad = states[200].copy()
    bad[layout.TARGET_TCP] = np.inf
    for _ in range(20):
        after = tick(bad)
        assert decision.guard.reason == IMPOSSIBLE
    assert after == 0.0
    assert decision.trouble == "target_tcp_x_mm = inf"
    assert decision.guard.trips == 1
    for state in states[201:400]:
        again = tick(state)
    assert np.isfinite(again)
    assert again > 1.0


@pytest.mark.parametrize("read_c", [np.nan, 850.0, -127.0])
def test_what_a_broken_sensor_reads_is_not_remembered(read_c: float) -> None:
    g = GraphBuilder()
    skin, core = g.input("skin_c"), g.state("core_c")
    after = core + 0.01 * (skin - core)
    bundle = create_bundle(
        name="late",
        machine="column",
        model_version=1,
        inputs=[Input("skin_c", "degC", "none", 100.0, "covariate", 15.0, 35.0)],
        outputs=[Output("error_z_um", "base_z")],
        states=[State("core_c", "degC", 20.0)],
        tick_graph=g.graph({"error_z_um": 5.0 * (after - 20.0)}, {"core_c": after}),
        safety=SafetyLimits(clamp_um=40.0, slew_um_s=5000.0),
    )
    live = LiveValues({"skin_c": 100.0})
    decision = Decision(CompiledBundle(bundle), TCP_MM, live=live, largest=LARGEST)
    stages, running = np.zeros(6, dtype=np.int64), real_states()[100]

    def ticks_at(skin_c: float, n: int) -> float:
        for _ in range(n):
            live.values[:] = skin_c
            out = decision.decide(running, age_s=0.0, elapsed_s=0.01, enabled=True, stages=stages)
        return float(out[2])

    before = ticks_at(22.0, 1000)
    assert before == pytest.approx(-10.0, abs=0.1)
    assert ticks_at(read_c, 20) == 0.0
    assert ticks_at(22.0, 20) == pytest.approx(before, abs=0.1)


def steady(watch: StampWatch, stamps: list[float], received: list[float], fresh: bool) -> list[bool]:
    return [watch.steady(s, r, fresh=fresh) for s, r in zip(stamps, received, strict=True)]


def ticks(n: int, first_s: float = 0.0) -> np.ndarray:
    return first_s + 0.002 * np.arange(n)


@pytest.mark.parametrize("fresh", [True, False])
def test_stamps_that_go_on_count_whatever_holds_them_up(fresh: bool) -> None:
    rng = np.random.default_rng(0)
    received = ticks(5000)
    # Late by up to 0.3 s, a gap of 3 s, and a clock that is 0.02 % slow.
    received = np.maximum.accumulate(received + 0.3 * (rng.random(5000) < 0.01))
    received[2500:] += 3.0
    stamps = 77.0 + 0.9998 * (ticks(5000) + np.where(np.arange(5000) < 2500, 0.0, 3.0))
    assert all(steady(StampWatch(), stamps.tolist(), received.tolist(), fresh))


@pytest.mark.parametrize("jump_s", [-0.001, -5.0, 3600.0, 0.6])
def test_after_a_jump_stamps_must_settle(jump_s: float) -> None:
    watch = StampWatch()
    assert all(steady(watch, ticks(100).tolist(), ticks(100).tolist(), True))
    received = ticks(1000, 0.2)
    found = steady(watch, (received + jump_s - 0.002).tolist(), received.tolist(), True)
    settled = round(_SETTLE_S / 0.002)
    assert not any(found[: settled - 1])
    assert all(found[settled + 1 :])


def test_states_that_lag_stay_old_unless_something_proves_them_new() -> None:
    for fresh in (False, True):
        watch = StampWatch()
        steady(watch, ticks(1000).tolist(), ticks(1000).tolist(), fresh)
        received = ticks(4000, 2.0)
        found = steady(watch, (received - 1.0).tolist(), received.tolist(), fresh)
        assert any(found) is fresh


def test_stamps_at_random_and_none_never_count() -> None:
    rng, watch = np.random.default_rng(0), StampWatch()
    steady(watch, ticks(10).tolist(), ticks(10).tolist(), True)
    received = ticks(3000, 0.02)
    wild = received - rng.uniform(0.0, 2.0, 3000)
    assert not any(steady(watch, wild.tolist(), received.tolist(), True)[5:])
    assert not watch.steady(np.nan, 7.0, fresh=True)
    assert watch.repeats(wild[-1])


def test_what_happens_at_every_tick_fills_no_journal() -> None:
    lines: list[tuple[str, dict[str, object]]] = []
    sparing = Sparing(lambda event, **details: lines.append((event, details)))
    for number in range(1000):
        sparing("clock_jump", step_s=number)
    sparing("reconnected")
    sparing.end()
    assert len([event for event, _ in lines if event == "clock_jump"]) <= 23
    told = sum(int(str(details.get("left_out", 0))) for _, details in lines)
    seen = sum(1 for event, details in lines if event == "clock_jump" and "step_s" in details)
    assert told + seen == 1000
    assert ("reconnected", {}) in lines
