from __future__ import annotations

import importlib
import sys
import types
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

from dtwin.errors import MissingPart
from dtwin.train.symbolic import OperonEngine, PySREngine, _read_hall_of_fame, refit


def test_operon_finds_a_law_and_repeats_itself() -> None:
    rng = np.random.default_rng(0)
    inputs = {"a": rng.uniform(0.5, 2, 400), "b": rng.uniform(0.5, 2, 400)}
    target = 3.0 * inputs["a"] * inputs["b"] + 0.5
    engine = OperonEngine(generations=15, population=200)
    front = engine.search(inputs, target, seed=3)
    assert [f.text for f in front] == [f.text for f in engine.search(inputs, target, seed=3)]
    fitted = refit(front, inputs, target)
    assert min(f.rms for f in fitted) < 0.01 * target.std()
    # The law must hold outside the box as well, not only fit inside it.
    best = min(fitted, key=lambda f: f.rms)
    far = {"a": np.array([5.0]), "b": np.array([7.0])}
    assert best.formula.values(far, best.constants) == pytest.approx([105.5], rel=0.05)


def test_pysr_without_julia_is_one_clear_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("PYTHON_JULIAPKG_EXE", raising=False)
    monkeypatch.setattr("shutil.which", lambda _: None)
    with pytest.raises(MissingPart) as caught:
        PySREngine().search({"a": np.zeros(3)}, np.zeros(3), 1)
    assert "Julia" in (caught.value.got or "")


@pytest.fixture
def pysr(monkeypatch: pytest.MonkeyPatch) -> types.ModuleType:
    """The real Python layer of PySR over a stand-in for Julia, which cannot be here."""
    pytest.importorskip("importlib.util").find_spec("pysr") or pytest.skip("pysr is not installed")
    stub = types.ModuleType("juliacall")
    stub.Main = mock.MagicMock()  # type: ignore[attr-defined]
    version = stub.Main.VERSION  # type: ignore[attr-defined]
    version.major, version.minor, version.patch = 1, 10, 4
    for name in ("AnyValue", "VectorValue"):
        setattr(stub, name, type(name, (), {}))
    stub.JuliaError = type("JuliaError", (Exception,), {})  # type: ignore[attr-defined]
    stub.convert = lambda *a, **_: a[-1]  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "juliacall", stub)
    return importlib.import_module("pysr")


def test_pysr_accepts_our_arguments(pysr: types.ModuleType) -> None:
    model = pysr.PySRRegressor(**PySREngine(iterations=7).arguments(seed=5))
    assert model.get_params()["niterations"] == 7
    assert model.get_params()["deterministic"] is True
    with pytest.raises(TypeError):
        pysr.PySRRegressor(no_such_argument=1)


def test_pysr_results_are_read_as_formulas(pysr: types.ModuleType, tmp_path: Path) -> None:
    (tmp_path / "hall_of_fame.csv").write_text(
        'Complexity,Loss,Equation\n1,2.5,"a"\n9,0.01,"(sin(a + a) * 3.2) + (0.7 * cos(b))"\n'
    )
    model = pysr.PySRRegressor.from_file(
        run_directory=str(tmp_path),
        n_features_in=2,
        feature_names_in=np.array(["a", "b"]),
        binary_operators=["+", "*"],
        unary_operators=["sin", "cos"],
    )
    front = _read_hall_of_fame(model.equations_)
    assert [f.complexity for f in front] == [1, 9]
    rng = np.random.default_rng(1)
    inputs = {"a": rng.normal(size=80), "b": rng.normal(size=80)}
    target = 3.0 * np.sin(2 * inputs["a"]) + 0.5 * np.cos(inputs["b"])
    assert refit(front, inputs, target)[-1].rms < 1e-6
