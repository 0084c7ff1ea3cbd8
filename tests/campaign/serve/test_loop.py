"""The loop in lock-step with the virtual cobot, and on the wall clock over real RTDE."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from bundles import path_bundle, sensor_bundle
from repeatable_error import repeatable_error_um

from dtwin.errors import DeviceError, InputError
from dtwin.features.path_inputs import PathInputs
from dtwin.features.windows import WindowContract
from dtwin.links import layout
from dtwin.links.ur import UrLink
from dtwin.machines.cobot import VirtualCobot
from dtwin.machines.motion import CircleCondition
from dtwin.serve.builder import GraphBuilder
from dtwin.serve.bundle import Bundle
from dtwin.serve.decision import Decision
from dtwin.serve.interface import Input, Output, SafetyLimits
from dtwin.serve.lockstep import serve_lockstep
from dtwin.serve.loop import ServeStatus, ServingLoop
from dtwin.serve.realtime import stop_on_signals
from dtwin.serve.runtime import CompiledBundle
from dtwin.serve.safety import REASONS

TCP_MM = np.array([0.0, 0.0, 158.3])
CONDITION = CircleCondition("YZ", 100.0, 6000.0, "CW")


@pytest.fixture(scope="module")
def cobot() -> VirtualCobot:
    return VirtualCobot(seed=3)


def angle_bundle(cobot: VirtualCobot, frame: str = "path_radial", role: str = "error") -> Bundle:
    """Look-up of the known repeatable error over the path angle of one condition."""
    controller = cobot.controller(CONDITION, setup="s1", repeat=1)
    states = []
    while not controller.done:
        states.append(controller.state().copy())
        controller.step(layout.correction_registers())
    angle = PathInputs(dict(layout.INDEX), TCP_MM).batch(np.array(states))[:, 0]
    _, radial_um, _ = repeatable_error_um(cobot, CONDITION)
    n = min(len(angle), len(radial_um))
    order = np.argsort(angle[:n], kind="stable")
    start, stop = angle.min(), angle.max()
    grid = np.linspace(start, stop, 1500)
    values = np.interp(grid, angle[:n][order], radial_um[:n][order])
    g = GraphBuilder()
    error = g.lookup(g.input("path_angle_rad"), start, grid[1] - grid[0], values.tolist())
    return path_bundle(
        inputs=[Input("path_angle_rad", "rad", "path", 500.0, "path", start - 0.1, stop + 0.1)],
        outputs=[Output("radial_error_um", frame, role)],
        states=(),
        tick_graph=g.graph({"radial_error_um": error}),
        safety=SafetyLimits(clamp_um=300.0, slew_um_s=20_000.0),
    )


def served(cobot: VirtualCobot, bundle: Bundle, **options: Any) -> tuple[float, ServeStatus, np.ndarray]:
    controller = cobot.controller(CONDITION, setup="s1", repeat=1)
    status = serve_lockstep(Decision(CompiledBundle(bundle), TCP_MM), controller, **options)
    recording = controller.recording()
    first, last = recording.window
    deviation_um = 1000 * recording.deviation_mm[first:last]
    angle = 2 * np.pi * np.arange(last - first) / (last - first)
    harmonic = np.column_stack([np.ones_like(angle), np.cos(angle), np.sin(angle)])
    fit = np.linalg.lstsq(harmonic, deviation_um, rcond=None)[0]
    return float(np.std(deviation_um - harmonic @ fit)), status, recording.deviation_mm


def test_correction_in_lockstep_reduces_the_measured_error(cobot: VirtualCobot) -> None:
    bundle = angle_bundle(cobot)
    plain_um, shadow, shadow_mm = served(cobot, bundle, mode="shadow")
    dry_um, dry, dry_mm = served(cobot, bundle, mode="dry-run")
    live_um, live, _ = served(cobot, bundle)
    assert np.array_equal(shadow_mm, dry_mm)
    assert plain_um == dry_um
    assert live_um < 0.6 * plain_um
    assert (live.clock, live.ended, live.timing["missed_states"]) == ("machine", "finished", 0)
    assert (shadow.last_sequence, dry.last_sequence) == (0, live.last_sequence)
    assert shadow.largest_um == pytest.approx(live.largest_um, rel=1e-3)
    assert live.largest_um > 20
    json.dumps(live.as_dict())


def test_wrong_sign_or_axis_makes_the_measured_error_worse(cobot: VirtualCobot) -> None:
    plain_um, _, _ = served(cobot, angle_bundle(cobot), mode="dry-run")
    flipped_um, _, _ = served(cobot, angle_bundle(cobot, role="correction"))
    assert flipped_um > 1.5 * plain_um
    across_um, _, _ = served(cobot, angle_bundle(cobot, frame="path_tangential"))
    assert across_um > 0.9 * plain_um


def test_more_transport_delay_leaves_more_error(cobot: VirtualCobot) -> None:
    bundle = angle_bundle(cobot)
    near, _, _ = served(cobot, bundle)
    far, status, _ = served(cobot, bundle, transport_ticks=40)
    assert far > 1.2 * near
    assert status.timing["state_age_ms"]["p50"] == pytest.approx(78.0)


def test_one_decision_serves_run_after_run_alike(cobot: VirtualCobot) -> None:
    decision = Decision(CompiledBundle(angle_bundle(cobot)), TCP_MM)
    measured = []
    for _ in range(2):
        controller = cobot.controller(CONDITION, setup="s1", repeat=1)
        serve_lockstep(decision, controller)
        measured.append(controller.recording().deviation_mm)
    assert np.array_equal(*measured)


def test_stop_in_lockstep_releases(cobot: VirtualCobot) -> None:
    asked: list[int] = []

    def stop() -> bool:
        asked.append(1)
        return len(asked) > 1000

    _, status, _ = served(cobot, angle_bundle(cobot), stop=stop)
    assert (status.ended, status.released) == ("stopped", True)
    assert status.reasons["disabled"] > 100


class HastyControl:
    """A control on its own clock whose stamps come closer together than its period, stand still, or go back."""

    def __init__(self, state: np.ndarray, steps_s: list[float]) -> None:
        self._state, self._steps_s, self.held = state.copy(), steps_s, [0.0]

    @property
    def done(self) -> bool:
        return not self._steps_s

    def state(self) -> np.ndarray:
        self._state[layout.TIMESTAMP] += self._steps_s.pop(0)
        return self._state

    def step(self, registers: np.ndarray) -> None:
        self.held.append(float(np.linalg.norm(registers[layout.REGISTER_OFFSET :])))


def test_in_lockstep_no_step_is_longer_than_the_stamps_allow(cobot: VirtualCobot) -> None:
    g = GraphBuilder()
    bundle = path_bundle(
        states=(),
        tick_graph=g.graph({"radial_error_um": 20.0 + 0.0 * g.input("path_angle_rad")}),
        safety=SafetyLimits(clamp_um=30.0, slew_um_s=500.0),
    )
    steps_s = [0.002] * 5 + [1e-4] * 10 + [0.002] * 5 + [0.0, -1.0, 0.002]
    control = HastyControl(cobot.controller(CONDITION, setup="s1", repeat=1).state(), list(steps_s))
    serve_lockstep(Decision(CompiledBundle(bundle), TCP_MM), control)
    # A stamp that stands or goes back earns the step of a period: the way to zero must stay open.
    allowed_um = [500.0 * (s if 0.0 < s < 0.002 else 0.002) for s in steps_s]
    assert np.diff(control.held) == pytest.approx(np.minimum(allowed_um, 20.0 - np.array(control.held[:-1])))


class Sensors:
    """Newest windows of a made recording."""

    def __init__(self, contract: WindowContract) -> None:
        self.contract = contract
        self.age_s = 0.01
        self.broken = False
        self.asked = 0

    def newest_window(self) -> tuple[np.ndarray | None, float]:
        self.asked += 1
        rng = np.random.default_rng(self.asked)
        block = 0.1 * rng.standard_normal((len(self.contract.channels), self.contract.n_samples))
        if self.broken:
            block[0, 5] = np.nan
        return (block if self.asked % 5 == 1 else None), self.age_s


def tick(decision: Decision, state: np.ndarray) -> str:
    stages = np.zeros(6, dtype=np.int64)
    decision.decide(state, age_s=0.0, elapsed_s=0.002, enabled=True, stages=stages)
    return REASONS[decision.guard.reason]


def test_sensor_windows_reach_the_equation_or_stop_the_correction(cobot: VirtualCobot) -> None:
    bundle = sensor_bundle()
    assert bundle.window is not None
    sensors = Sensors(bundle.window)
    decision = Decision(CompiledBundle(bundle), TCP_MM, sensors=sensors)
    state = cobot.controller(CONDITION, setup="s1", repeat=1).state()
    for _ in range(20):
        reason = tick(decision, state)
    assert reason == "ok"
    assert not decision.guard.at_rest
    sensors.age_s = 5.0
    assert tick(decision, state) == "stale_window"
    sensors.age_s, sensors.broken = 0.01, True
    for _ in range(20):
        reason = tick(decision, state)
    assert reason == "not_finite"
    assert decision.guard.at_rest


def test_missing_sensors_and_inputs_are_refused() -> None:
    with pytest.raises(InputError, match="sensor windows"):
        Decision(CompiledBundle(sensor_bundle()), TCP_MM)
    other = Sensors(WindowContract(1000.0, 150, 15, ("a_g",), ("rms",)))
    with pytest.raises(InputError, match="sensor windows"):
        Decision(CompiledBundle(sensor_bundle()), TCP_MM, sensors=other)
    g = GraphBuilder()
    bundle = path_bundle(
        inputs=[Input("temperature_c", "degC", "none", 1.0, "covariate", 10.0, 40.0)],
        states=(),
        tick_graph=g.graph({"radial_error_um": 2.0 * g.input("temperature_c")}),
    )
    with pytest.raises(InputError, match="does not provide"):
        Decision(CompiledBundle(bundle), TCP_MM)
    Decision(CompiledBundle(bundle), TCP_MM, {"temperature_c": 21.0})


@pytest.fixture
def robot() -> Iterator[tuple[str, Callable[..., dict[str, Any]]]]:
    """A virtual robot behind its real RTDE server, in a process of its own."""
    host = f"127.{20 + os.getpid() % 200}.{os.getpid() // 200 % 250}.250"
    process = subprocess.Popen(
        [sys.executable, "-m", "studies.machines.rtde_server", f"--host={host}", "--repeat-forever", "--control"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdin is not None
    assert process.stdout is not None
    reader, writer = process.stdout, process.stdin

    def do(action: str, **arguments: Any) -> dict[str, Any]:
        writer.write(json.dumps({"do": action, **arguments}) + "\n")
        writer.flush()
        return dict(json.loads(reader.readline()))

    try:
        assert json.loads(reader.readline())["ready"]
        yield host, do
    finally:
        writer.close()
        process.wait(300)
        reader.close()


def loop_for(link: Any, mode: Any = "live") -> ServingLoop:
    limits = SafetyLimits(clamp_um=30.0, slew_um_s=2000.0, stale_s=0.1)
    bundle = path_bundle(safety=limits)
    return ServingLoop(Decision(CompiledBundle(bundle), TCP_MM), link, mode=mode)


@pytest.mark.system
def test_serving_over_rtde_corrects_and_releases(robot: Any) -> None:
    host, _ = robot
    with UrLink(host) as link:
        loop = loop_for(link)
        # How large it is hangs on how far the robot came: until it is large, however slow this computer is.
        status = loop.run(300.0, stop=lambda: loop._largest_um > 1.0, priority=0)
        until, applied = time.monotonic() + 300.0, np.inf
        while applied > 0.5:
            assert time.monotonic() < until, applied
            state = link.wait_state(0.2)
            if state is not None and state[layout.APPLIED_SEQUENCE] == status.last_sequence:
                applied = np.abs(state[layout.APPLIED : layout.APPLIED + 3]).max()
    assert (status.clock, status.ended, status.fault) == ("wall", "stopped", None)
    assert status.released
    assert status.largest_um > 1.0
    assert status.timing["ticks"] > 0
    assert status.realtime["garbage_collection"] == "used"
    json.dumps(status.as_dict())


@pytest.mark.system
def test_controller_that_drops_the_link_ends_the_serving_with_a_reason(robot: Any) -> None:
    host, do = robot
    asked: list[int] = []

    def stop() -> bool:
        asked.append(1)
        if len(asked) == 150:
            do("drop")
        return False

    with UrLink(host) as link:
        status = loop_for(link).run(20.0, stop=stop, priority=0)
    assert status.fault is not None
    assert status.ended == status.fault["code"]
    assert status.ended.startswith("ur.")


@pytest.mark.system
def test_controller_that_stalls_is_answered_with_zero(robot: Any) -> None:
    host, do = robot
    asked: list[int] = []

    def stop() -> bool:
        asked.append(1)
        if len(asked) == 150:
            do("stall", seconds=0.3)
        return len(asked) > 400

    with UrLink(host) as link:
        loop = loop_for(link)
        status = loop.run(20.0, stop=stop, priority=0)
    assert status.ended == "stopped"
    assert status.timing["timeouts"] > 0
    assert status.reasons["stale"] > 0
    assert status.released


@pytest.mark.system
def test_shadow_sends_nothing(robot: Any) -> None:
    host, _ = robot
    with UrLink(host) as link:
        status = loop_for(link, "shadow").run(0.5, priority=0)
        state = link.wait_state(1.0)
        assert state is not None
        assert not state[layout.APPLIED : layout.APPLIED + 3].any()
    assert status.last_sequence == 0


class BrokenLink:
    """Fails after a while, as a link does whose driver died."""

    received_s = 0.0

    def __init__(self, state: np.ndarray, lasts: int) -> None:
        self.state, self.left = state, lasts
        self.sent: list[np.ndarray] = []

    def wait_state(self, timeout_s: float) -> np.ndarray | None:
        self.left -= 1
        if self.left < 0:
            raise DeviceError("the driver died", code="ur.died")
        self.received_s = time.monotonic()
        return self.state

    def send(self, offset_um: np.ndarray, sequence: int) -> None:
        if self.left < 0:
            raise DeviceError("the driver died", code="ur.died")
        self.sent.append(offset_um.copy())


def test_dead_driver_is_reported_and_never_raised(cobot: VirtualCobot) -> None:
    link = BrokenLink(cobot.controller(CONDITION, setup="s1", repeat=1).state(), 50)
    status = loop_for(link).run(5.0, priority=0)
    assert (status.ended, status.released) == ("ur.died", False)
    assert status.fault == {"code": "ur.died", "message": "the driver died"}


def test_interrupt_becomes_a_question(cobot: VirtualCobot) -> None:
    link = BrokenLink(cobot.controller(CONDITION, setup="s1", repeat=1).state(), 10**9)
    before = signal.getsignal(signal.SIGINT)
    with stop_on_signals() as stop:
        asked: list[int] = []

        def after_a_while() -> bool:
            asked.append(1)
            if len(asked) == 200:
                os.kill(os.getpid(), signal.SIGINT)
            return stop()

        status = loop_for(link).run(60.0, stop=after_a_while, priority=0)
    assert signal.getsignal(signal.SIGINT) is before
    assert (status.ended, status.released) == ("stopped", True)
    assert link.sent[-1].tolist() == [0.0, 0.0, 0.0]
    steps = np.linalg.norm(np.diff(link.sent, axis=0), axis=1)
    assert steps.max() <= 2000.0 * 0.02 + 1e-9


def test_until_something_runs_an_interrupt_is_one() -> None:
    with stop_on_signals(from_first_asked=True) as stop:
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
        assert not stop()
        os.kill(os.getpid(), signal.SIGINT)
        assert stop()


def test_only_a_rising_sequence_is_sent(cobot: VirtualCobot) -> None:
    link = BrokenLink(cobot.controller(CONDITION, setup="s1", repeat=1).state(), 10)
    loop = ServingLoop(Decision(CompiledBundle(path_bundle()), TCP_MM), link, first_sequence=layout.SEQUENCE_LIMIT)
    numbers: list[int] = []
    link.send = lambda offset, sequence: numbers.append(sequence)  # type: ignore[method-assign]
    loop.run(5.0, priority=0)
    assert numbers[:3] == [layout.SEQUENCE_LIMIT, 1, 2]


class LossyLink:
    """A machine's end that holds what arrives, and loses whole stretches of what is sent."""

    def __init__(self, state: np.ndarray, lost: list[range]) -> None:
        self.state, self.lost, self.sent, self.held = state.copy(), lost, 0, np.zeros(3)
        self.received_s, self._silent, self.steps = 0.0, 0, [0.0]
        self._let_go = False

    def wait_state(self, timeout_s: float) -> np.ndarray | None:
        self.state[layout.TIMESTAMP] += 0.002
        self.received_s = time.monotonic()
        self._silent += 1
        if self._silent > 20 and self.held.any():
            self.held, self._let_go = np.zeros(3), True
            self.state[layout.APPLIED_SEQUENCE] = 0
        return self.state

    def send(self, offset_um: np.ndarray, sequence: int) -> None:
        self.sent += 1
        if any(self.sent in stretch for stretch in self.lost) or (self._let_go and offset_um.any()):
            return
        self.steps.append(float(np.linalg.norm(offset_um - self.held)))
        self.held, self._let_go, self._silent = offset_um.copy(), False, 0
        self.state[layout.APPLIED_SEQUENCE] = sequence


@pytest.mark.parametrize(
    "lost", [[range(1, 4)], [range(2, 40)], [range(3, 40)], [range(9, 60), range(80, 81), range(90, 300)]]
)
def test_lost_corrections_neither_jump_nor_end_it(cobot: VirtualCobot, lost: list[range]) -> None:
    link = LossyLink(cobot.controller(CONDITION, setup="s1", repeat=1).state(), lost)
    limits = SafetyLimits(clamp_um=30.0, slew_um_s=2000.0, stale_s=0.02, trips_to_latch=99)
    g = GraphBuilder()
    bundle = path_bundle(
        safety=limits, states=(), tick_graph=g.graph({"radial_error_um": 20.0 + 0.0 * g.input("path_angle_rad")})
    )
    loop = ServingLoop(Decision(CompiledBundle(bundle), TCP_MM), link)  # type: ignore[arg-type]
    seen: list[float] = []
    until_s = time.monotonic() + 300.0

    def stop() -> bool:
        time.sleep(0.001)
        seen.append(float(np.linalg.norm(link.held)))
        # Corrected again after the last loss.
        done = link.sent > lost[-1].stop + 20 and seen[-1] > 19.9
        return done or time.monotonic() > until_s

    status = loop.run(60.0, stop=stop, priority=0)
    assert status.ended == "stopped"
    assert seen[-1] > 19.9
    assert max(link.steps) <= 2000.0 * 0.002 * (1 + 1e-9)
    assert not link.held.any()


class MadeTime:
    """A clock that goes on by what is asked of it."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def monotonic(self) -> float:
        self.now_s += 1e-6
        return self.now_s

    def perf_counter_ns(self) -> int:
        return int(self.now_s * 1e9)

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds


class LyingLink:
    """A machine's end that holds what arrives, and now and then says something else of it, or of the time."""

    def __init__(self, state: np.ndarray, clock: MadeTime, lies: list[str]) -> None:
        self.state, self.clock, self.lies = state.copy(), clock, lies
        self.rng, self.received_s, self.lie = np.random.default_rng(5), 0.0, ""
        self.held, self.number, self.sent_s, self.too_far_um = np.zeros(3), 0, 0.0, 0.0

    def wait_state(self, timeout_s: float) -> np.ndarray | None:
        told_before = self.lie in ("foreign", "dies")
        lies = told_before or (np.linalg.norm(self.held) > 29.0 and self.rng.random() < 0.2)
        lie = self.lie = str(self.rng.choice(self.lies)) if lies else ""
        self.clock.sleep(1e-5 if lie == "burst" else self.rng.uniform(0.0, 0.05) if lie == "stall" else 0.01)
        if lie == "dies":
            raise DeviceError("no state comes any more", code="states.silent")
        self.received_s = self.clock.now_s
        self.state[layout.TIMESTAMP] += {"stands": 0.0, "back": -3.0, "ahead": 1e6, "no time": np.nan}.get(lie, 0.01)
        told = {"let go": 0.0, "none": np.nan, "huge": 1e12, "older": max(self.number - 25, 1), "foreign": 5e6}
        state = self.state.copy()
        state[layout.APPLIED_SEQUENCE] = told.get(lie, self.number)
        self.state[layout.TIMESTAMP] = np.nan_to_num(self.state[layout.TIMESTAMP])
        return state

    def send(self, offset_um: np.ndarray, sequence: int) -> None:
        step_um = float(np.linalg.norm(offset_um - self.held))
        allowed_um = 2000.0 * min(self.clock.now_s - self.sent_s, 0.01)
        self.too_far_um = max(self.too_far_um, step_um - allowed_um)
        self.held, self.number, self.sent_s = offset_um.copy(), sequence, self.clock.now_s


@pytest.mark.parametrize(
    "lies",
    [
        ["let go"],
        ["none", "huge", "older"],
        ["foreign"],
        ["dies"],
        ["stands", "back", "ahead", "no time", "burst", "stall"],
        ["let go", "none", "huge", "older", "stands", "back", "ahead", "burst", "stall"],
    ],
)
def test_no_step_is_too_long_whatever_is_said(
    cobot: VirtualCobot, monkeypatch: pytest.MonkeyPatch, lies: list[str]
) -> None:
    clock = MadeTime()
    monkeypatch.setattr("dtwin.serve.loop.time", clock)
    link = LyingLink(cobot.controller(CONDITION, setup="s1", repeat=1).state(), clock, lies)
    g = GraphBuilder()
    bundle = path_bundle(
        safety=SafetyLimits(clamp_um=30.0, slew_um_s=2000.0, stale_s=0.1, trips_to_latch=9999),
        states=(),
        tick_graph=g.graph({"radial_error_um": 29.9 + 0.0 * g.input("path_angle_rad")}),
    )
    loop = ServingLoop(Decision(CompiledBundle(bundle), TCP_MM), link, period_s=0.01)  # type: ignore[arg-type]
    status = loop.run(4.0, priority=0)
    assert status.ended == {"foreign": "serve.other_writer", "dies": "states.silent"}.get(lies[0], "duration")
    assert status.largest_um == pytest.approx(29.9)
    assert link.too_far_um < 1e-6
    assert status.released
    assert not link.held.any()
