"""The tape gives what the slow evaluation gives, for any graph and any input."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from dtwin.serve.builder import Expression, GraphBuilder
from dtwin.serve.graph import OPERATORS, Graph
from dtwin.serve.tape import Tape

NAMES = ("x", "y", "z")
ordinary = sorted(set(OPERATORS) - {"pow_int", "lookup"})
floats = st.floats(allow_nan=True, allow_infinity=True, width=64)
mild = st.floats(-20, 20)


@st.composite
def graphs(draw: st.DrawFn) -> Graph:
    g = GraphBuilder()
    known: list[Expression] = [g.input(n) for n in NAMES] + [g.state("s")]
    for _ in range(draw(st.integers(1, 25))):
        kind = draw(st.integers(0, 9))

        def pick() -> Expression:
            return draw(st.sampled_from(known[-8:] + known[:4]))

        if kind == 0:
            known.append(g.constant(draw(mild)))
        elif kind == 1:
            known.append(g.power(pick(), draw(st.sampled_from([-3, -1, 1, 2, 3, 5, 32]))))
        elif kind == 2:
            values = draw(st.lists(mild, min_size=2, max_size=6))
            start, spacing = draw(mild), draw(st.floats(0.01, 5))
            known.append(g.lookup(pick(), start, spacing, values, draw(st.booleans())))
        else:
            op = draw(st.sampled_from(ordinary))
            known.append(g.apply(op, *(pick() for _ in range(OPERATORS[op].arity))))
    return g.graph({"a": known[-1], "b": known[len(known) // 2]}, {"s": draw(st.sampled_from(known))})


@settings(deadline=None, max_examples=300)
@given(graphs(), st.lists(st.tuples(*[st.one_of(mild, floats)] * 3), min_size=1, max_size=4))
def test_tape_is_the_reference(graph: Graph, ticks: list[tuple[float, float, float]]) -> None:
    tape = Tape(graph, NAMES, {"s": 0.5}, ["a", "b"])
    state = {"s": 0.5}
    for tick in ticks:
        out, state = graph.evaluate(dict(zip(NAMES, tick, strict=True)), state)
        expected = np.array([out["a"], out["b"]])
        found = tape.run(np.array(tick))
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-300, equal_nan=True)
        # What follows a tick is judged from the same state, so that rounding cannot pile up.
        np.testing.assert_allclose(tape.state[0], state["s"], rtol=1e-9, atol=1e-300)
        tape.state[0] = state["s"]


@settings(deadline=None, max_examples=60)
@given(graphs())
def test_graph_survives_its_dictionary(graph: Graph) -> None:
    assert Graph.from_dict(graph.to_dict(), "graph") == graph


@settings(deadline=None, max_examples=60)
@given(graphs(), st.lists(st.tuples(mild, mild, mild), min_size=1, max_size=6))
def test_rows_are_ticks(graph: Graph, rows: list[tuple[float, float, float]]) -> None:
    one, many = (Tape(graph, NAMES, {"s": 0.5}, ["a", "b"]) for _ in range(2))
    single = np.array([one.run(np.array(row)).copy() for row in rows])
    assert many.run_many(np.array(rows)).tobytes() == single.tobytes()
