"""Time of one decision: features of a 6 x 1500 window plus equation, and the equation alone.

Beside them, in the same run, the features alone as the usual script of numpy and scipy computes them: times are
of the processor, their ratio hardly is.

Run: OMP_NUM_THREADS=1 python benchmarks/bench_decision.py [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from bench_features import usual_script

from dtwin.features.path_inputs import PATH_INPUT_UNITS, PATH_INPUTS
from dtwin.features.windows import WindowContract
from dtwin.links import layout
from dtwin.serve.band import COVARIANCE, Band
from dtwin.serve.builder import GraphBuilder
from dtwin.serve.bundle_file import create_bundle
from dtwin.serve.decision import Decision
from dtwin.serve.interface import Input, Output
from dtwin.serve.realtime import realtime
from dtwin.serve.runtime import CompiledBundle
from dtwin.train.twin_band import half_width

CHANNELS = tuple(f"{place}_{axis}_g" for place in ("wrist", "base") for axis in "xyz")
FEATURES = (
    "mean_absolute_value",
    "variance",
    "rms",
    "shape_factor",
    "impulse_factor",
    "crest_factor",
    "kurtosis",
    "skewness",
    "mean_frequency",
    "band_power",
)
CONTRACT = WindowContract(25_600.0, 1500, 51, CHANNELS, FEATURES, (500.0, 2000.0))


def compiled(*, banded: bool = False) -> CompiledBundle:
    """Four harmonics of the path, joint levers times speeds, and six sensor features.

    ``banded``: with the half width of ten parameters that are not independent of each other.
    """
    g = GraphBuilder()
    angle = g.input("path_angle_rad")
    terms = [3.0 / k * g.apply("sin", angle * k + 0.1 * k) for k in range(1, 5)]
    for j in range(1, 7):
        reversal = g.apply("tanh", 40.0 * g.input(f"qd{j}_rad_s"))
        terms.append(0.002 * g.input(f"lever_{j}_mm_rad") * reversal)
    terms += [g.input(name) * 0.5 for name in CONTRACT.columns[2::10]]
    graph = g.graph({"radial_error_um": g.total(terms)})
    band = None
    if banded:
        factor = np.random.default_rng(1).standard_normal((10, 10))
        band = Band(COVARIANCE, g.graph({"radial_error_um": half_width(g, terms[:10], factor)}))
    inputs = [
        Input(name, PATH_INPUT_UNITS[name], "path", 500.0, "path", -2000.0, 2000.0)
        for name in PATH_INPUTS
        if name in graph.inputs
    ]
    inputs += [Input(name, "g", "sensor", 500.0, "feature", 0.0, 5.0) for name in CONTRACT.columns[2::10]]
    return CompiledBundle(
        create_bundle(
            name="bench",
            machine="bench",
            model_version=1,
            inputs=inputs,
            window=CONTRACT,
            outputs=[Output("radial_error_um", "path_radial")],
            tick_graph=graph,
            band=band,
        )
    )


class OneWindow:
    """Delivers a new window at every tick."""

    contract = CONTRACT

    def __init__(self) -> None:
        rng = np.random.default_rng(0)
        self.block = 0.1 * rng.standard_normal((len(CHANNELS), CONTRACT.n_samples))

    def newest_window(self) -> tuple[np.ndarray, float]:
        return self.block, 0.0


def microseconds(work: Callable[[], object], repeats: int) -> dict[str, float]:
    work()
    times = np.empty(repeats)
    for i in range(repeats):
        start = time.perf_counter_ns()
        work()
        times[i] = time.perf_counter_ns() - start
    empty = min(-(time.perf_counter_ns() - time.perf_counter_ns()) for _ in range(1000))
    p50, p99 = np.percentile(times - empty, [50, 99]) / 1e3
    return {"p50_us": round(float(p50), 3), "p99_us": round(float(p99), 3)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--short", action="store_true", help="the same code with little data")
    arguments = parser.parse_args()
    fewer = 100 if arguments.short else 1
    model, sensors = compiled(), OneWindow()
    bundle = model.bundle
    kernel, flat = CONTRACT.kernel(), sensors.block.reshape(-1)
    values, codes = np.zeros((6, 10)), np.zeros(6, dtype=np.int64)
    tick, picked = np.zeros(len(bundle.tick_inputs)), np.arange(6) * 10 + 2
    spread = values.reshape(-1)

    def features_and_equation() -> None:
        kernel.compute(flat, 0, CONTRACT.n_samples, values, codes)
        model.window(spread[picked])
        model.tick(tick)

    decision = Decision(model, np.array([0.0, 0.0, 158.3]), sensors=sensors)
    banded = compiled(banded=True)
    with_band = Decision(banded, np.array([0.0, 0.0, 158.3]), sensors=OneWindow())
    state = layout.empty_state()
    state[layout.RUNTIME_RUNNING] = state[layout.SAFETY_OK] = 1.0
    stages = np.zeros(6, dtype=np.int64)

    def whole_decision() -> None:
        decision.decide(state, age_s=0.0, elapsed_s=0.002, enabled=True, stages=stages)

    def decision_with_band() -> None:
        with_band.decide(state, age_s=0.0, elapsed_s=0.002, enabled=True, stages=stages)

    def all_of_them() -> dict[str, Any]:
        return {
            "equation": microseconds(model.evaluate, 50_000 // fewer),
            "features_and_equation": microseconds(features_and_equation, 5_000 // fewer),
            "whole_decision_with_path_and_guard": microseconds(whole_decision, 5_000 // fewer),
            "equation_with_band_and_fading": microseconds(banded.evaluate, 50_000 // fewer),
            "whole_decision_with_band": microseconds(decision_with_band, 5_000 // fewer),
            "usual_script": microseconds(lambda: usual_script(sensors.block), 500 // fewer),
        }

    result: dict[str, Any] = {"load_before": os.getloadavg()[0], "nodes": len(bundle.tick_graph.nodes)}
    result["as any process"] = all_of_them()
    with realtime() as allowed:
        result["as the loop, by default"] = all_of_them()
    result["allowed"] = allowed
    for how in ("as any process", "as the loop, by default"):
        times = result[how]
        result[how]["usual_script_over_features_and_equation"] = round(
            times["usual_script"]["p50_us"] / times["features_and_equation"]["p50_us"], 1
        )
    if arguments.json:
        print(json.dumps(result))
        return
    print(f"6 channels x 1500 samples x 10 features, one core; load before {result['load_before']:.2f}")
    for how in ("as any process", "as the loop, by default"):
        print(how)
        for name, value in result[how].items():
            print(f"  {name:36s} {value}")
    print(f"real-time priority: {allowed['priority']}, memory lock: {allowed['memory_lock']}")


if __name__ == "__main__":
    main()
