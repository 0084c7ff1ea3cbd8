"""Networks, tables, flanks and gates of a positioning error, on the published lathe."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from runpy import run_path

import numpy as np
import pytest

from dtwin.kinds.linear._bundle import (
    Flanks,
    _fit_harmonics,
    axis_number,
    deployed_bundle,
    flanks_bundle,
    flanks_of,
    held,
    is_positioning_bundle,
    printed_pair,
    remembering_bundle,
)
from dtwin.kinds.linear._gates import along, positioning_gates, screw_logged, screw_metrics
from dtwin.kinds.linear._models import Averages, Bidirectional, Unidirectional, fit_dual, whole_turns
from dtwin.kinds.linear._simulate import mapping_plan
from dtwin.kinds.linear._small_net import SmallNet, new_net
from dtwin.machines.printed_network import MAPPED_IN, MAPPED_MM, PITCH_IN, read_network
from dtwin.serve.builder import Expression, GraphBuilder
from dtwin.serve.bundle_file import create_bundle
from dtwin.serve.graph_code import to_python
from dtwin.serve.interface import Input, Output, SafetyLimits
from dtwin.serve.runtime import CompiledBundle
from studies.lathe_paper import exact_averages, table_steps
from studies.net_trainings import TRAININGS

NETWORK = read_network()
UM_PER_IN, UM_PER_MM = 25400.0, 1000.0
MM_PER_IN = 25.4
PITCH_MM, TRAVEL_MM = MM_PER_IN * PITCH_IN, (0.0, 1041.4)


@pytest.fixture(scope="module")
def exact() -> Averages:
    return exact_averages(NETWORK, mapping_plan())


@pytest.fixture(scope="module")
def flanks() -> Flanks:
    fine = exact_averages(NETWORK, replace(mapping_plan(), step=0.013))
    return flanks_of(printed_pair(NETWORK).full, fine, PITCH_MM, 5, MAPPED_MM)


def golden() -> tuple[np.ndarray, np.ndarray]:
    rows = [[g["dir"], g["pos_in"], g["compensation_in"]] for g in NETWORK.golden]
    return np.array(rows)[:, :2], np.array(rows)[:, 2]


def test_the_runtime_gives_what_the_printed_program_gives(tmp_path: Path) -> None:
    inputs, told = golden()
    assert len(told) == 14
    assert np.max(np.abs(-NETWORK.error_in(inputs[:, 0], inputs[:, 1]) - told)) < 1e-12
    bundle = deployed_bundle(printed_pair(NETWORK), "printed", "lathe")
    found = -CompiledBundle(bundle).run(inputs * [1.0, MM_PER_IN])[:, 0] / UM_PER_IN
    assert np.max(np.abs(found - told)) < 1e-12
    # The same through the export.
    path = tmp_path / "exported.py"
    path.write_text(to_python(bundle.tick_graph, "tick"), encoding="utf-8")
    tick = run_path(str(path))["tick"]
    for (direction, position), value in zip(inputs.tolist(), told.tolist(), strict=True):
        named = {"direction_1": direction, "position_mm": position * MM_PER_IN}
        assert abs(-tick(named, {})[0]["error_z_um"] / UM_PER_IN - value) < 1e-12


@pytest.mark.parametrize("reach_mm", [MAPPED_MM, (-1200.0, 0.0)])
def test_the_remainder_is_that_of_c_everywhere(reach_mm: tuple[float, float]) -> None:
    bundle = deployed_bundle(printed_pair(NETWORK), "printed", "lathe", reach_mm)
    position = np.concatenate([np.arange(-160, 161) * 0.25, np.linspace(-3.0, 45.0, 997)])
    inputs = np.column_stack([np.zeros(len(position)), position * MM_PER_IN])
    found = CompiledBundle(bundle).run(inputs)[:, 0] / UM_PER_IN
    # Next to a whole turn rounding decides on which side of it a position lies.
    told = NETWORK.error_in(np.zeros(len(position)), position * MM_PER_IN / MM_PER_IN)
    assert np.max(np.abs(found - told)) < 1e-11


def test_the_deployed_equation_fails_each_gate_by_name() -> None:
    verdicts = positioning_gates(deployed_bundle(printed_pair(NETWORK), "printed", "lathe"), PITCH_MM, MAPPED_MM)
    assert {v.gate: v.passed for v in verdicts} == {
        "no seam at a turn of the screw": False,
        "ends held outside of the mapped travel": False,
        "no step at reversal": False,
        "defined at standstill": False,
    }
    told = {v.gate: v.reason for v in verdicts}
    # 63 and 190 millionths of an inch; -0.0235 in at -0.1 in instead of about -0.0005.
    assert "+1.60 µm, reverse +4.82 µm" in told["no seam at a turn of the screw"]
    assert "582.5 µm" in told["ends held outside of the mapped travel"]


def test_flanks_with_a_memory_pass_every_gate(flanks: Flanks) -> None:
    bundle = flanks_bundle(flanks, "flanks", "lathe", TRAVEL_MM)
    verdicts = positioning_gates(bundle, PITCH_MM, MAPPED_MM)
    assert [v.passed for v in verdicts] == [True] * 4, verdicts


@pytest.mark.parametrize("reach_mm", [(-160.0, 0.0), (-80.0, 80.0), (50.0, 210.0)])
def test_where_an_axis_has_its_zero_is_no_fault_of_its_ends(reach_mm: tuple[float, float]) -> None:
    builder = GraphBuilder()

    def limit(position: Expression, play_um: float = 0.0) -> Expression:
        return 20.0 * builder.apply("sin", held(builder, position, reach_mm) * (np.pi / 100.0)) + play_um

    room = (reach_mm[0] - 130.0, reach_mm[1] + 130.0)
    bundle = remembering_bundle(builder, (limit, partial(limit, play_um=6.0)), "wave", "mill", room)
    verdicts = positioning_gates(bundle, 10.0, reach_mm)
    assert [v.passed for v in verdicts] == [True] * 4, verdicts


def test_any_axis_is_corrected_and_told_its_position_in_millimetres(flanks: Flanks) -> None:
    bundle = flanks_bundle(flanks, "flanks", "mill", TRAVEL_MM, "X")
    (position,), (output,) = bundle.inputs, bundle.outputs
    assert (position.name, position.unit, position.high) == ("position_mm", "mm", TRAVEL_MM[1])
    assert (output.name, output.frame, axis_number(bundle)) == ("error_x_um", "base_x", 0)


def test_a_bundle_from_before_is_told_inches() -> None:
    builder = GraphBuilder()
    graph = builder.graph({"error_z_um": builder.input("position_in") * 2.0})
    bundle = create_bundle(
        name="old",
        machine="lathe",
        model_version=1,
        tick_graph=graph,
        safety=SafetyLimits(clamp_um=100.0),
        inputs=[Input("position_in", "in", "none", 100.0, "controller", 0.0, 41.0)],
        outputs=[Output("error_z_um", "base_z")],
    )
    assert is_positioning_bundle(bundle)
    assert along(bundle, np.array([25.4, 50.8])).tolist() == pytest.approx([2.0, 4.0])


def test_what_training_logged_of_the_screw_is_read_in_millimetres_also_from_before() -> None:
    before = {"screw_pitch_in": 0.25, "mapped_from_in": 1.0, "mapped_to_in": 40.0}
    assert screw_logged(before) == screw_logged(screw_metrics(6.35, MAPPED_MM)) == (6.35, 25.4, 1016.0)
    assert np.isnan(screw_logged({})).all()


def test_flanks_need_no_flag_and_turn_round_in_the_overshoot(flanks: Flanks) -> None:
    bundle = flanks_bundle(flanks, "flanks", "lathe", TRAVEL_MM)
    up = np.linspace(23.0, 1018.0, 2001)
    error = along(bundle, np.concatenate([up, up[::-1]]))
    inside = (up >= MAPPED_MM[0]) & (up <= MAPPED_MM[1])
    for way, found in ((0.0, error[:2001]), (1.0, error[:2000:-1])):
        flags = np.full(2001, way)
        there = up - flanks.error_um(flags, up) / UM_PER_MM
        assert np.max(np.abs(found - flanks.error_um(flags, there))[inside]) < 1e-6


def test_flanks_never_change_more_than_the_axis_moves(flanks: Flanks) -> None:
    bundle = flanks_bundle(flanks, "flanks", "lathe", TRAVEL_MM)
    rng = np.random.default_rng(3)
    path = np.clip(508.0 + np.cumsum(rng.normal(size=4000)) * 0.025, *MAPPED_MM)
    moved, changed = np.abs(np.diff(path)), np.abs(np.diff(along(bundle, path))) / UM_PER_MM
    assert np.all(changed <= 1.1 * moved + 1e-12)


def test_harmonics_come_back_from_their_own_sum() -> None:
    x = np.linspace(0.0, 2.0, 97)
    angle = 2 * np.pi * x / 0.25
    found = _fit_harmonics(x, 3.0 + 2.0 * np.sin(angle) - np.cos(2 * angle), 0.25, 3)
    assert found.constant == pytest.approx(3.0)
    assert np.allclose(found.sine, [2, 0, 0], atol=1e-9)
    assert np.allclose(found.cosine, [0, -1, 0], atol=1e-9)


def test_derivatives_of_a_small_net_are_right() -> None:
    rng = np.random.default_rng(0)
    net = new_net(5, ((0.0, 1.0), (1.0, 40.0)), rng)
    inputs = np.column_stack([rng.integers(0, 2, 9), rng.uniform(1, 40, 9)]).astype(float)
    target = rng.normal(size=9)
    values = net.parameters()
    output, jacobian = net.with_jacobian(inputs)
    sse, gradient = net.gradient(inputs, target)
    assert sse == pytest.approx(float(np.sum((output - target) ** 2)))
    for k in range(len(values)):
        nudge = np.zeros(len(values))
        nudge[k] = 1e-6
        high, low = (net.with_parameters(values + s * nudge).evaluate(inputs) for s in (1, -1))
        assert np.allclose((high - low) / 2e-6, jacobian[:, k], atol=1e-5)
    assert np.allclose(2.0 * jacobian.T @ (output - target), gradient)


@pytest.mark.parametrize("training", TRAININGS.values(), ids=TRAININGS)
def test_every_training_learns_and_stops_at_its_goal(training: Callable[..., tuple[SmallNet, int]]) -> None:
    x = np.linspace(-1.0, 1.0, 60)[:, None]
    net = new_net(6, ((-1.0, 1.0),), np.random.default_rng(1))
    target = np.sin(3.0 * x[:, 0])
    found, epochs = training(net, x, target, 3000, 0.05)
    assert np.sum((found.evaluate(x) - target) ** 2) <= 0.05 < np.sum((net.evaluate(x) - target) ** 2)
    assert 0 < epochs < 3000
    again, _ = training(net, x, target, 3000, 0.05)
    assert np.array_equal(again.parameters(), found.parameters())


def test_the_order_of_the_trainings_is_the_published_one(exact: Averages) -> None:
    inputs, target = whole_turns(exact, PITCH_IN)
    assert inputs.shape == (314, 2)
    found = []
    for training in TRAININGS.values():
        net = new_net(30, ((0.0, 1.0), MAPPED_IN), np.random.default_rng(0))
        best, _ = training(net, inputs, target, 300, 4e-8)
        found.append(np.sum((best.evaluate(inputs) - target) ** 2))
    lm, bfgs, scg, rprop = found
    assert lm <= 4e-8 < bfgs
    assert 1000 * bfgs > scg > 1000 * lm
    assert rprop > 1000 * lm


def test_the_pair_reaches_its_goals(exact: Averages) -> None:
    pair = fit_dual(exact, PITCH_IN, 1)
    assert [t.sse <= goal for t, goal in zip(pair.trained, (4e-8, 9e-9), strict=True)] == [True] * 2
    direction, position, error = exact.stacked()
    assert np.max(np.abs(pair.error_um(direction, position) - error)) < 1.5e-4 * UM_PER_IN


def test_tables_alias_the_screw_when_their_step_divides_the_pitch() -> None:
    left = {t["model"]: t for t in table_steps(NETWORK)}
    one, quarter, fine = (left[f"bidirectional table, {step} in"]["rms_um"] for step in ("1", "0.25", "0.025"))
    assert one == pytest.approx(quarter, rel=0.02)
    assert fine < 0.15 * quarter
    assert left["one table and one backlash, 0.025 in"]["rms_um"] > 4 * fine


def test_tables_are_straight_between_entries_and_held_beyond() -> None:
    # The illustrative tables of the source: forward and reverse, 0 to 4 in.
    a = Averages(
        np.arange(5.0), np.array([1.0, 1.0, 0.0, -1.0, -2.0]) * 1e-3, np.array([-1.0, -1.0, -2.0, -3.0, -4.0]) * 1e-3
    )
    two = Bidirectional(a)
    assert two.error_um(np.array([0.0, 1.0]), np.array([2.5, 2.5])) == pytest.approx([-5e-4, -2.5e-3])
    assert two.error_um(np.zeros(2), np.array([-9.0, 9.0])) == pytest.approx([1e-3, -2e-3])
    backlash = float(np.mean(a.reverse_um - a.forward_um))
    one = Unidirectional(a).error_um(np.array([1.0]), np.array([3.0]))
    assert one == pytest.approx([-1e-3 + backlash])
