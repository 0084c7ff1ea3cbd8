"""The virtual cobot as a whole: truth, determinism, reach, and correction."""

from __future__ import annotations

import numpy as np
import pytest
from repeatable_error import repeatable_error_um

from dtwin.kinematics import UR10E, jacobian_kernel
from dtwin.links import layout
from dtwin.machines.cobot import CircleCondition, VirtualCobot
from dtwin.machines.controller import CircleController

FAST = CircleCondition("XY", 100.0, 6000.0, "CCW")
ARC = CircleCondition("YZ", 100.0, 6000.0, "CW")


@pytest.fixture(scope="module")
def cobot() -> VirtualCobot:
    return VirtualCobot(seed=5)


def test_a_run_is_a_function_of_seed_setup_repeat_and_condition(cobot: VirtualCobot) -> None:
    first = cobot.measure(ARC, setup="s1", repeat=1)
    again = VirtualCobot(seed=5).measure(ARC, setup="s1", repeat=1)
    np.testing.assert_array_equal(first.deviation_mm, again.deviation_mm)
    for one, two in zip(first.groups, again.groups, strict=True):
        for name in one.columns:
            np.testing.assert_array_equal(one.columns[name], two.columns[name])
    other_repeat = cobot.measure(ARC, setup="s1", repeat=2)
    np.testing.assert_array_equal(other_repeat.truth.setup.eccentricity_um, first.truth.setup.eccentricity_um)
    np.testing.assert_array_equal(other_repeat.truth.parts_um["joints"], first.truth.parts_um["joints"])
    assert not np.array_equal(other_repeat.truth.parts_um["drift"], first.truth.parts_um["drift"])
    other_setup = cobot.measure(ARC, setup="s2", repeat=1)
    assert other_setup.truth.setup.eccentricity_um[1] != first.truth.setup.eccentricity_um[1]
    other_machine = VirtualCobot(seed=6).measure(ARC, setup="s1", repeat=1)
    assert not np.array_equal(other_machine.truth.parts_um["joints"], first.truth.parts_um["joints"])


@pytest.mark.parametrize("radius", [100.0, 150.0, 300.0])
@pytest.mark.parametrize("plane", ["XY", "YZ", "XZ"])
def test_every_cell_of_the_campaign_is_reached_on_one_branch(cobot: VirtualCobot, plane: str, radius: float) -> None:
    recording = cobot.measure(CircleCondition(plane, radius, 6000.0, "CW"), setup="s", repeat=1)
    columns = recording.groups[1].columns
    q = np.column_stack([columns[f"target_q_{j}_rad"] for j in range(1, 7)])
    target = np.column_stack([columns[f"target_tcp_{a}_mm"] for a in "xyz"])
    tcp = np.array([0.0, 0.0, 158.3])
    reached, _ = UR10E.forward_many(q, tcp)
    np.testing.assert_allclose(reached, target, atol=1e-6)
    assert np.abs(np.diff(q, axis=0)).max() < 0.02
    scale = np.array([500.0] * 3 + [1.0] * 3)[:, None]
    least = min(np.linalg.svd(jacobian_kernel(row, UR10E.dh, tcp) / scale)[1].min() for row in q[::50])
    assert least > 0.1
    window_s = (recording.window[1] - recording.window[0]) / recording.sample_rate_hz
    arc = 2 * np.pi if recording.condition.plane == "XY" else np.pi
    assert 0.99 * arc * radius / 100.0 < window_s < 1.25 * arc * radius / 100.0
    assert recording.window[0] > 0
    assert recording.window[1] < len(recording.deviation_mm)


def test_ball_bar_is_the_sum_of_the_parts_of_the_truth(cobot: VirtualCobot) -> None:
    recording = cobot.measure(FAST, setup="s1", repeat=1)
    truth = recording.truth
    start, end = recording.window
    clock = truth.bar_start_s + np.arange(start, end) / 200 / (1 + 1e-6 * truth.bar_ppm)
    total = np.interp(clock, truth.t_s, sum(truth.parts_um.values()))
    left = 1e3 * recording.deviation_mm[start:end] - total
    assert left.std() == pytest.approx(3.5, rel=0.15)
    assert abs(left.mean()) < 1.0


def test_repeatable_error_is_what_repeats(cobot: VirtualCobot) -> None:
    t_s, radial_um, vector_um = repeatable_error_um(cobot, FAST)
    truth = cobot.measure(FAST, setup="s9", repeat=4).truth
    np.testing.assert_allclose(radial_um, truth.parts_um["joints"] + truth.parts_um["structure"], atol=1e-6)
    np.testing.assert_array_equal(t_s, truth.t_s)
    assert vector_um.shape == (len(t_s), 3)


def run(controller: CircleController, corrections_um: np.ndarray | None) -> CircleController:
    tick = 0
    while not controller.done:
        registers = layout.correction_registers()
        if corrections_um is not None:
            at = min(tick, len(corrections_um) - 1)
            registers = layout.correction_registers(tick + 1, tuple(corrections_um[at]))
        controller.step(registers)
        tick += 1
    return controller


def test_controller_without_correction_is_the_same_machine(cobot: VirtualCobot) -> None:
    controller = run(cobot.controller(ARC, setup="s1", repeat=1), None)
    measured = cobot.measure(ARC, setup="s1", repeat=1)
    np.testing.assert_array_equal(controller.recording().deviation_mm, measured.deviation_mm)


def test_oracle_correction_removes_most_of_the_repeatable_error(cobot: VirtualCobot) -> None:
    _, _, vector_um = repeatable_error_um(cobot, FAST)
    lead = 7  # delay of two ticks and a lag of four, plus the tick itself
    controller = run(cobot.controller(FAST, setup="s1", repeat=1), -vector_um[lead:])
    recording = controller.recording()
    parts = recording.truth.parts_um
    inside = slice(2000, -2000)
    _, radial_um, _ = repeatable_error_um(cobot, FAST)
    after = (parts["joints"] + parts["structure"] + parts["correction"])[inside]
    assert after.std() < 0.4 * radial_um[inside].std()


def test_offset_is_latched_by_sequence_limited_delayed_and_released(cobot: VirtualCobot) -> None:
    controller = cobot.controller(ARC, setup="s1", repeat=1)
    applied = []
    for tick in range(150):
        sequence = min(tick, 50)
        wanted = (9000.0, -20.0, float("nan"))
        if tick == 20:
            controller.step(layout.correction_registers(19, (0.0, 0.0, 0.0)))
        else:
            controller.step(layout.correction_registers(sequence, wanted if sequence else (0, 0, 0)))
        applied.append(controller.state()[layout.APPLIED : layout.APPLIED + 3].copy())
    offsets = np.array(applied)
    first = int(np.argmax(offsets[:, 1] < 0))
    assert first == 1 + 2
    assert offsets[:, 0].max() <= 500.0
    assert np.diff(offsets[:, 0]).max() <= 20_000 * 0.002 + 1e-9
    assert offsets[50, 1] == pytest.approx(-20.0, abs=0.1)
    assert np.all(offsets[:, 2] == 0.0)
    np.testing.assert_allclose(offsets[-1], 0.0, atol=0.5)
    assert controller.state()[layout.APPLIED_SEQUENCE] == 0, "none is in force"
    # What was dropped comes back only from zero.
    for sequence, offset_um in ((51, 80.0), (52, 80.0), (53, 0.0)):
        controller.step(layout.correction_registers(sequence, (offset_um, 0.0, 0.0)))
        assert not controller.commanded_um.any()
    assert controller.state()[layout.APPLIED_SEQUENCE] == 53
    controller.step(layout.correction_registers(54, (10.0, 0.0, 0.0)))
    assert controller.commanded_um[0] == pytest.approx(10.0)


def test_old_sequence_number_does_nothing_after_a_restart(cobot: VirtualCobot) -> None:
    controller = cobot.controller(ARC, setup="s1", repeat=1)
    controller.adopt_sequence(77)
    for sequence in (77, 77, 77, 77, 77, 77):
        controller.step(layout.correction_registers(sequence, (50.0, 0.0, 0.0)))
    assert not controller.state()[layout.APPLIED : layout.APPLIED + 3].any()
    controller.step(layout.correction_registers(78, (50.0, 0.0, 0.0)))
    assert not controller.commanded_um.any(), "a jump: this client began before the program did"
    controller.step(layout.correction_registers(79))
    for sequence in range(80, 100):
        controller.step(layout.correction_registers(sequence, (50.0, 0.0, 0.0)))
    assert controller.state()[layout.APPLIED] > 40.0


def test_correction_moves_tool_and_encoders_alike(cobot: VirtualCobot) -> None:
    plain = cobot.controller(ARC, setup="s1", repeat=1)
    pushed = cobot.controller(ARC, setup="s1", repeat=1)
    for tick in range(100):
        plain.step(layout.correction_registers())
        pushed.step(layout.correction_registers(tick + 1, (100.0, -50.0, 25.0)))
    tcp = slice(layout.ACTUAL_TCP, layout.ACTUAL_TCP + 3)
    moved_um = 1e3 * (pushed.state()[tcp] - plain.state()[tcp])
    np.testing.assert_allclose(moved_um, [100, -50, 25], atol=8)


def test_speed_scaling_stretches_the_run_and_a_protective_stop_ends_motion(cobot: VirtualCobot) -> None:
    controller = cobot.controller(ARC, setup="s1", repeat=1)
    controller.set_speed_scaling(0.5)
    for _ in range(1500):
        controller.step(layout.correction_registers())
    state = controller.state()
    assert state[layout.SPEED_SCALING] == 0.5
    assert state[layout.TIMESTAMP] == pytest.approx(3.0)
    speed = np.linalg.norm(state[layout.TARGET_SPEED : layout.TARGET_SPEED + 3])
    assert speed == pytest.approx(50.0, rel=1e-3)
    controller.protective_stop()
    for _ in range(100):
        controller.step(layout.correction_registers())
    state = controller.state()
    assert state[layout.SAFETY_OK] == 0.0
    assert state[layout.RUNTIME_RUNNING] == 0.0
    assert not state[layout.TARGET_SPEED : layout.TARGET_SPEED + 3].any()
    assert not controller.done


def test_layout_constants_name_their_columns() -> None:
    assert len(set(layout.NAMES)) == layout.N
    for constant, name in {
        "TARGET_Q": "target_q_1_rad",
        "ACTUAL_QD": "actual_qd_1_rad_s",
        "TARGET_TCP": "target_tcp_x_mm",
        "TARGET_SPEED": "target_speed_x_mm_s",
        "SEGMENT_TIME": "segment_time_s",
        "CENTRE": "centre_x_mm",
        "FEED": "feed_mm_min",
        "APPLIED": "applied_x_um",
    }.items():
        assert getattr(layout, constant) == layout.INDEX[name]
