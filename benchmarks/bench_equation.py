"""One tick of a bundle against what MLflow and scikit-learn need for the same prediction.

The same equation is asked for one row: as a compiled bundle, as an MLflow pyfunc with its
signature and a data frame (how a registry's model is used as it is), and, fitted to the same
rows, as a forest of 100 trees. All in one process, in turn, on one core.

Run: OMP_NUM_THREADS=1 python benchmarks/bench_equation.py [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")

import mlflow
import numpy as np
import pandas as pd
from mlflow.models import infer_signature, set_model
from sklearn.ensemble import RandomForestRegressor

from dtwin.features.path_inputs import PATH_INPUT_UNITS
from dtwin.serve.builder import GraphBuilder
from dtwin.serve.bundle_file import create_bundle, load_bundle, save_bundle
from dtwin.serve.interface import Input, Output
from dtwin.serve.runtime import CompiledBundle

ANGLE = "path_angle_rad"
LEVERS = tuple(f"lever_{j}_mm_rad" for j in range(1, 7))
SPEEDS = tuple(f"qd{j}_rad_s" for j in range(1, 7))
NAMES = (ANGLE, *LEVERS, *SPEEDS)


class EquationModel(mlflow.pyfunc.PythonModel):  # type: ignore[name-defined,misc]
    """The bundle's equation behind MLflow's interface, by the very same compiled tape."""

    def load_context(self, context: object) -> None:
        self.model = load_bundle(Path(context.artifacts["bundle"]))  # type: ignore[attr-defined]

    def predict(self, context: object, model_input: pd.DataFrame, params: object = None) -> np.ndarray:
        return self.model.run(model_input[list(NAMES)].to_numpy())[:, 0]


def equation() -> CompiledBundle:
    """Four harmonics of the path and six joint reversals."""
    g = GraphBuilder()
    terms = [3.0 / k * g.apply("sin", g.input(ANGLE) * k + 0.1 * k) for k in range(1, 5)]
    for lever, speed in zip(LEVERS, SPEEDS, strict=True):
        terms.append(0.002 * g.input(lever) * g.apply("tanh", 40.0 * g.input(speed)))
    boxes = {ANGLE: (-10.0, 10.0)} | dict.fromkeys(LEVERS, (-900.0, 900.0))
    boxes |= dict.fromkeys(SPEEDS, (-0.2, 0.2))
    inputs = [Input(n, PATH_INPUT_UNITS[n], "path", 500.0, "path", *boxes[n]) for n in NAMES]
    return CompiledBundle(
        create_bundle(
            name="bench",
            machine="bench",
            model_version=1,
            inputs=inputs,
            outputs=[Output("radial_error_um", "path_radial")],
            tick_graph=g.graph({"radial_error_um": g.total(terms)}),
        )
    )


def pyfunc_of(model: CompiledBundle, rows: pd.DataFrame, folder: Path) -> object:
    """Save the equation as MLflow would hold it, from code and not as a pickle; load it."""
    bundle = save_bundle(model.bundle, folder / "bundle.json")
    path = folder / "model"
    mlflow.pyfunc.save_model(
        path=str(path),
        python_model=str(Path(__file__).resolve()),
        artifacts={"bundle": str(bundle)},
        signature=infer_signature(rows, model.run(rows.to_numpy())[:, 0]),
        pip_requirements=[],
    )
    return mlflow.pyfunc.load_model(str(path))


def microseconds(work: Callable[[], object], budget_s: float) -> dict[str, float]:
    work()
    times: list[int] = []
    until_ns = time.perf_counter_ns() + int(budget_s * 1e9)
    while (start := time.perf_counter_ns()) < until_ns and len(times) < 200_000:
        work()
        times.append(time.perf_counter_ns() - start)
    p50, p99 = np.percentile(times, [50, 99]) / 1e3
    return {"p50_us": round(float(p50), 2), "p99_us": round(float(p99), 2), "n": len(times)}


def measure(budget_s: float) -> dict[str, object]:
    model = equation()
    rng = np.random.default_rng(1)
    low = np.array([i.low for i in model.bundle.inputs])
    high = np.array([i.high for i in model.bundle.inputs])
    values = low + (high - low) * rng.random((3000, len(NAMES)))
    truth = model.run(values)[:, 0].copy()
    rows = pd.DataFrame(values, columns=list(NAMES))
    forest = RandomForestRegressor(100, max_depth=10, random_state=1, n_jobs=1).fit(values, truth)
    row, tick, one = rows.iloc[:1], values[0].copy(), values[:1]
    with tempfile.TemporaryDirectory() as folder:
        served = pyfunc_of(model, rows.head(50), Path(folder))
        same = float(served.predict(row)[0])  # type: ignore[attr-defined]
        assert abs(same - truth[0]) < 1e-9, "not the same model"
        found = {
            "bundle": microseconds(lambda: model.tick(tick), budget_s),
            "pyfunc": microseconds(lambda: served.predict(row), budget_s),  # type: ignore[attr-defined]
            "forest": microseconds(lambda: forest.predict(one), budget_s),
        }
    base = found["bundle"]["p50_us"]
    ratios = {name: round(found[name]["p50_us"] / base) for name in ("pyfunc", "forest")}
    return {**found, "ratio_of_p50": ratios, "goal": 100}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--short", action="store_true", help="the same code with little data")
    parser.add_argument("--seconds", type=float, default=3.0, help="time for each of the three")
    chosen = parser.parse_args()
    found = measure(0.05 if chosen.short else chosen.seconds)
    if chosen.json:
        print(json.dumps(found))
        return
    for name in ("bundle", "pyfunc", "forest"):
        print(f"{name:8s} {found[name]}")
    for name, ratio in found["ratio_of_p50"].items():  # type: ignore[attr-defined]
        print(f"{name} / bundle: {ratio} (goal: at least {found['goal']})")


if __name__ == "__main__":
    main()
else:
    set_model(EquationModel())
