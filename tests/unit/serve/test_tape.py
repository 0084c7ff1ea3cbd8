from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dtwin.serve._tape_program import MULTIPLY_ADD, SINE_AND_COSINE, tape_runs
from dtwin.serve.builder import GraphBuilder
from dtwin.serve.tape import Tape, _sine_and_cosine


@settings(deadline=None)
@given(st.one_of(st.floats(), st.floats(-1e6, 1e6), st.integers(-999, 999).map(math.radians)))
def test_sine_and_cosine_are_those_of_the_library(x: float) -> None:
    expected = (np.nan, np.nan) if math.isinf(x) else (math.sin(x), math.cos(x))
    np.testing.assert_allclose(_sine_and_cosine(x), expected, rtol=0, atol=3e-16)


def test_sine_keeps_the_sign_of_zero() -> None:
    assert math.copysign(1.0, _sine_and_cosine(-0.0)[0]) == -1.0


def test_sine_near_multiples_of_a_quarter_turn_is_exact_to_its_own_size() -> None:
    for k in range(-400, 400):
        x = k * math.pi / 2
        s, c = _sine_and_cosine(x)
        small, true = (s, math.sin(x)) if k % 2 == 0 else (c, math.cos(x))
        assert small == pytest.approx(true, rel=1e-6, abs=0.0)


def test_states_that_swap_read_each_other_before_they_change() -> None:
    g = GraphBuilder()
    a, b = g.state("a"), g.state("b")
    graph = g.graph({"a": a, "b": b, "sum": a + b}, {"a": b, "b": a, "c": a + b})
    tape = Tape(graph, (), {"a": 1.0, "b": 2.0, "c": 0.0}, ["a", "b", "sum"])
    assert tape.run(np.zeros(0)).tolist() == [1.0, 2.0, 3.0]
    assert tape.run(np.zeros(0)).tolist() == [2.0, 1.0, 3.0]
    assert tape.state.tolist() == [1.0, 2.0, 3.0]


def test_runs_hold_every_operation_once_and_operands_first() -> None:
    g = GraphBuilder()
    x = g.input("x")
    waves = [g.apply(f, x * k) for k in range(1, 6) for f in ("sin", "cos")]
    total = g.total([w * k for k, w in enumerate(waves, start=2)])
    graph = g.graph({"y": total})
    runs = tape_runs(graph, list(range(len(graph.nodes))), [])
    known = {i for i, node in enumerate(graph.nodes) if node.op in ("const", "input")}
    for _, instructions in runs:
        for one in instructions:
            assert one.reads <= known
            assert not one.writes & known
            known |= one.writes
    fused = sum(len(part) for op, part in runs if op == MULTIPLY_ADD)
    assert known | {i for i, node in enumerate(graph.nodes) if node.op == "mul"} == set(range(len(graph.nodes)))
    assert fused == 9
    assert [(op, len(part)) for op, part in runs if op == SINE_AND_COSINE] == [(24, 5)]
    assert len(runs) < 6


def test_evaluate_is_run_without_the_copy() -> None:
    g = GraphBuilder()
    tape = Tape(g.graph({"y": g.input("x") * 3.0}), ("x",), {}, ["y"])
    tape.inputs[0] = 2.0
    tape.evaluate()
    assert tape.outputs[0] == tape.run(np.array([2.0]))[0] == 6.0
    with pytest.raises(ValueError, match="2 inputs given"):
        tape.run(np.zeros(2))
