from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from dtwin.features.path_inputs import PATH_INPUTS
from dtwin.kinds.circular._library import Gear, Library, Mode, _free_step, weighted_sum
from dtwin.serve.builder import GraphBuilder
from dtwin.serve.tape import Tape


@pytest.mark.parametrize("mode", [Mode(9.4, 0.035), Mode(26.0, 0.1)])
def test_a_free_step_is_the_differential_equation(mode: Mode) -> None:
    w = 2 * np.pi * mode.frequency_hz

    def slope(_: float, y: np.ndarray) -> list[float]:
        return [y[1], -2 * mode.damping_ratio * w * y[1] - w**2 * y[0]]

    start = np.array([0.3, -2.0])
    exact = solve_ivp(slope, (0, 0.1), start, rtol=1e-11, atol=1e-12).y[:, -1]
    step = np.array(_free_step(mode, 0.002))
    found = start
    for _ in range(50):
        found = step @ found
    np.testing.assert_allclose(found, exact, rtol=1e-7, atol=1e-9)


def test_multiples_of_a_wave_are_the_functions_that_they_are_named_after() -> None:
    library = Library([Gear(1, 400.0), Gear(1, 100.0), Gear(1, 200.0), Gear(2, 100.5)], [])
    inputs = np.random.default_rng(0).uniform(-2.0, 2.0, len(PATH_INPUTS))
    given = dict(zip(PATH_INPUTS, inputs.tolist(), strict=True))
    wanted = {
        f"lever{j}*{function}({order:g}*q{j})": given[f"lever_{j}_mm_rad"]
        * getattr(np, function)(order * given[f"q{j}_rad"])
        for j, order in [(1, 1), (1, 2), (1, 3), (6, 3), (1, 100), (1, 200), (1, 400), (2, 100.5)]
        for function in ("cos", "sin")
    }
    atoms = {atom.name: factors for atom, factors in library.atoms.items()}
    terms = {name: weighted_sum(library.builder, [(1.0, atoms[name])]) for name in wanted}
    graph = library.builder.graph(terms, library.updates)
    found = Tape(graph, PATH_INPUTS, library.initial, list(wanted)).run(inputs)
    np.testing.assert_allclose(found, list(wanted.values()), rtol=0, atol=1e-12)


def test_a_sum_in_brackets_is_the_sum() -> None:
    g = GraphBuilder()
    x, y, z = (g.input(name) for name in "xyz")
    terms = [(2.0, (x, y)), (-3.0, (x,)), (0.5, (x, y, z)), (4.0, (z,)), (7.0, ())]
    graph = g.graph({"sum": weighted_sum(g, terms)})
    given = {"x": 1.7, "y": -0.3, "z": 11.0}
    expected = 2 * 1.7 * -0.3 - 3 * 1.7 + 0.5 * 1.7 * -0.3 * 11 + 4 * 11 + 7
    assert graph.evaluate(given, {})[0]["sum"] == pytest.approx(expected, rel=1e-13)
    assert sum(node.op == "mul" for node in graph.nodes) == 4
    nothing = g.graph({"sum": weighted_sum(g, [])})
    assert nothing.evaluate({}, {})[0]["sum"] == 0.0
