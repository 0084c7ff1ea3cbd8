"""Structured text and URScript say what the graph computes, by an evaluator of what is emitted."""

from __future__ import annotations

import math

import numpy as np
import pytest
from emitted import StructuredText, URScript
from test_export import BROKEN, INPUTS, STATES, every_operator, expected, lagging, samples

from dtwin.errors import InputError
from dtwin.serve.builder import GraphBuilder
from dtwin.serve.export_plc import to_structured_text, to_urscript


def test_structured_text_agrees_and_remembers() -> None:
    graph = every_operator()
    block = StructuredText(to_structured_text(graph, INPUTS, {"s": 0.5, "u": 0.0}))
    rows = []
    for row in samples().tolist():
        out = block.tick(dict(zip(INPUTS, row, strict=True)))
        rows.append([out["a"], out["b"], block.memory["s"], block.memory["u"]])
    np.testing.assert_allclose(np.array(rows), expected(graph), rtol=1e-12, atol=1e-12)


def test_urscript_agrees_and_hands_its_states_back() -> None:
    graph = every_operator()
    script = URScript(to_urscript(graph, INPUTS, STATES))
    state, rows = [0.5, 0.0], []
    for row in samples().tolist():
        values = script.functions["dtwin_correction"](*row, *state)
        state = values[2:]
        rows.append(values)
    np.testing.assert_allclose(np.array(rows), expected(graph), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("broken", BROKEN)
def test_states_do_not_remember_what_is_no_number(broken: tuple[float, float]) -> None:
    graph = lagging()
    block = StructuredText(to_structured_text(graph, INPUTS, {"s": 0.5, "u": 0.25}))
    script = URScript(to_urscript(graph, INPUTS, STATES)).functions["dtwin_correction"]
    block.tick(dict(zip(INPUTS, broken, strict=True)))
    assert [block.memory["s"], block.memory["u"]] == [0.5, 0.25]
    assert script(*broken, 0.5, 0.25)[1:] == [0.5, 0.25]
    block.tick({"x": 1.0, "y": 2.0})
    assert [block.memory["s"], block.memory["u"]] == pytest.approx([0.55, 0.425])
    assert script(1.0, 2.0, 0.5, 0.25)[1:] == pytest.approx([0.55, 0.425])


@pytest.mark.parametrize("periodic", [True, False])
def test_what_is_no_number_is_no_place_of_a_table(periodic: bool) -> None:
    g = GraphBuilder()
    graph = g.graph({"out": g.lookup(g.input("x"), -2.0, 0.5, [1.0, -2.5, 3.0], periodic=periodic)})
    block = StructuredText(to_structured_text(graph, ("x",), {}))
    assert np.isnan(block.tick({"x": math.nan})["out"])


def test_only_what_is_used_is_written() -> None:
    g = GraphBuilder()
    graph = g.graph({"out": g.input("x") * 2.0})
    assert "FUNCTION DTWIN" not in to_structured_text(graph, ("x",), {})
    assert to_urscript(graph, ("x",), ()).count("def ") == 1


@pytest.mark.parametrize("name", ["2x", "a__b", "tmp1", "x y", "x;y"])
def test_a_name_that_could_become_code_is_refused(name: str) -> None:
    g = GraphBuilder()
    graph = g.graph({"out": g.input(name) * 2.0})
    for write in (lambda: to_structured_text(graph, (name,), {}), lambda: to_urscript(graph, (name,), ())):
        with pytest.raises(InputError, match="no identifier"):
            write()
