"""Exports say what the bundle computes: C and Python by running them, text and LaTeX by eye."""

from __future__ import annotations

import ctypes
import math
import os
import shutil
import subprocess
from pathlib import Path
from runpy import run_path

import numpy as np
import pytest
from bundles import path_bundle

from dtwin.serve.builder import GraphBuilder
from dtwin.serve.graph import Graph
from dtwin.serve.graph_code import to_c, to_latex, to_python, to_text

INPUTS, STATES, OUTPUTS = ("x", "y"), ("s", "u"), ("a", "b")


def every_operator() -> Graph:
    g = GraphBuilder()
    x, y, s = g.input("x"), g.input("y"), g.state("s")
    one = [g.apply(f, x) for f in ("neg", "abs", "exp", "sin", "cos", "tan", "tanh")]
    one += [g.apply(f, x) for f in ("logistic", "sign", "step", "square")]
    one += [g.apply(f, abs(y) + 0.1) for f in ("sqrt", "log")]
    two = [g.apply(f, x, y) for f in ("add", "sub", "mul", "atan2", "min", "max")]
    two += [x / (y * y + 1.0), g.power(x, 5), g.power(y * y + 1.0, -3)]
    tables = [g.lookup(x, -2.0, 0.5, [1.0, -2.5, 3.0, 0.25, 7.0], periodic=p) for p in (True, False)]
    total = g.total([*one, *two, *tables, 1e-3 * s, -4.0 * y])
    return g.graph({"a": total, "b": total * x - 1.5e-7}, {"s": s + x, "u": total})


def samples() -> np.ndarray:
    fixed = [[0.0, 0.0], [-2.0, 3.0], [0.5, -0.5], [-7.3, 2.0]]
    return np.concatenate([fixed, np.random.default_rng(0).uniform(-4, 4, (200, 2))])


def expected(graph: Graph) -> np.ndarray:
    state, rows = {"s": 0.5, "u": 0.0}, []
    for row in samples():
        out, state = graph.evaluate(dict(zip(INPUTS, row, strict=True)), state)
        rows.append([out["a"], out["b"], state["s"], state["u"]])
    return np.array(rows)


def compiled(graph: Graph, library: Path, outputs: tuple[str, ...] = OUTPUTS) -> ctypes.CDLL:
    """Return the exported C as a library; the test is skipped without a compiler."""
    gcc = shutil.which("gcc")
    if gcc is None:
        if os.environ.get("DTWIN_REQUIRE_ALL"):
            pytest.fail("gcc is not installed (Debian package gcc)")
        pytest.skip("gcc is not installed (Debian package gcc)")
    source = library.with_suffix(".c")
    source.write_text(to_c(graph, INPUTS, STATES, outputs, "my-model"))
    flags = ["-O2", "-ffp-contract=off", "-std=c99", "-Wall", "-Werror", "-Wno-unused-function"]
    subprocess.run([gcc, *flags, "-shared", "-fPIC", source, "-o", library, "-lm"], check=True)
    return ctypes.CDLL(str(library))


def lagging() -> Graph:
    """Return a graph whose states follow both inputs; ``max`` of some languages takes a NaN for a number."""
    g = GraphBuilder()
    x, y, s, u = g.input("x"), g.apply("max", g.input("y"), -4.0), g.state("s"), g.state("u")
    return g.graph({"a": s + u}, {"s": s + 0.1 * (x - s), "u": u + 0.1 * (y - u)})


BROKEN = [(math.nan, 1.0), (1.0, math.nan), (math.inf, 1.0), (1.0, -math.inf)]
"""Inputs of which one is no finite number."""


@pytest.mark.parametrize("broken", BROKEN)
def test_the_states_of_c_and_python_do_not_remember_what_is_no_number(
    tmp_path: Path, broken: tuple[float, float]
) -> None:
    graph, path = lagging(), tmp_path / "exported_tick.py"
    path.write_text(to_python(graph))
    _, after = run_path(str(path))["tick"](dict(zip(INPUTS, broken, strict=True)), {"s": 0.5, "u": 0.25})
    assert after == {"s": 0.5, "u": 0.25}
    state, out = (ctypes.c_double * 2)(0.5, 0.25), (ctypes.c_double * 1)()
    tick = compiled(graph, tmp_path / "tick.so", ("a",)).dtwin_my_model
    tick((ctypes.c_double * 2)(*broken), state, out)
    assert [*state] == [0.5, 0.25]
    tick((ctypes.c_double * 2)(1.0, 2.0), state, out)
    assert [*state] == pytest.approx([0.55, 0.425])


def test_c_agrees_and_exports_only_its_own_names(tmp_path: Path) -> None:
    graph, library = every_operator(), tmp_path / "tick.so"
    tick = compiled(graph, library).dtwin_my_model
    state, out, rows = (ctypes.c_double * 2)(0.5, 0.0), (ctypes.c_double * 2)(), []
    for row in samples():
        tick((ctypes.c_double * 2)(*row), state, out)
        rows.append([*out, *state])
    np.testing.assert_allclose(np.array(rows), expected(graph), rtol=1e-12, atol=1e-12)
    if shutil.which("nm"):
        names = subprocess.run(
            ["nm", "-D", "--defined-only", library], check=True, capture_output=True, text=True
        ).stdout.split()[2::3]
        assert names == ["dtwin_my_model"]


def test_python_agrees(tmp_path: Path) -> None:
    graph, path = every_operator(), tmp_path / "exported_tick.py"
    path.write_text(to_python(graph))
    tick, state, rows = run_path(str(path))["tick"], {"s": 0.5, "u": 0.0}, []
    for row in samples():
        out, state = tick(dict(zip(INPUTS, row, strict=True)), state)
        rows.append([out["a"], out["b"], state["s"], state["u"]])
    np.testing.assert_allclose(np.array(rows), expected(graph), rtol=1e-12, atol=1e-12)


def test_text_is_short_and_readable() -> None:
    text = to_text(path_bundle().tick_graph)
    assert "radial_error_um = " in text
    assert "sin(path_angle_rad)" in text
    assert "next kept = " in text


def test_latex_has_balanced_braces_and_every_name() -> None:
    latex = to_latex(every_operator())
    assert latex.count("{") == latex.count("}")
    assert latex.count(r"\left") == latex.count(r"\right")
    assert r"\mathrm{radial\_error\_um}" in to_latex(path_bundle().tick_graph)
    g = GraphBuilder()
    spoilt = to_latex(g.graph({"y": g.apply("sin", g.input("x}\n\\input{/etc/passwd"))}))
    assert r"\sin\left(\mathrm{x\_\_\_input\_\_etc\_passwd}\right)" in spoilt


def test_shared_terms_do_not_multiply_the_text() -> None:
    g = GraphBuilder()
    x = g.input("x")
    for _ in range(40):
        x = g.apply("sin", x) * x + x
    assert len(to_text(g.graph({"y": x}))) < 10_000


def test_values_of_a_chain_stay_equal(tmp_path: Path) -> None:
    g = GraphBuilder()
    x = g.input("x")
    graph = g.graph({"y": (x + 1.0) * (x + 1.0) - g.power(x, -2) / 3.0})
    path = tmp_path / "exported_tick.py"
    path.write_text(to_python(graph))
    out, _ = run_path(str(path))["tick"]({"x": 0.7}, {})
    assert out["y"] == pytest.approx(1.7**2 - 0.7**-2 / 3, rel=1e-15)
    assert math.isfinite(out["y"])
