"""One tick of a correction of tones: compute time, and what the system takes away in between.

The bundle's tick (gain and lag held, sine made) is evaluated a million times in one process, one call at a
time, as a loop would; a tick of an 8 kHz loop is 125 us long, a tenth of it is allowed. Calls that took
longer than the median by more than 5 us are not the equation's: the system took the processor away (there
is no real-time priority here). They are counted apart. The window (features of 5 s and both equations)
is timed as well: it is evaluated once a second.

Run: OMP_NUM_THREADS=1 python benchmarks/bench_tone_tick.py [--calls N] [--json]
"""

from __future__ import annotations

import argparse
import json
import time

import numpy as np

from dtwin.features.windows import StreamingWindow
from dtwin.kinds.sinusoidal._groups import groups_of
from dtwin.kinds.sinusoidal._simulate import QUICK, virtual_runs, virtual_slide
from dtwin.serve.bundle import Bundle
from dtwin.serve.runtime import CompiledBundle
from studies.turning_fit import fitted_tones

TICK_US, BUDGET_US, PREEMPTED_US = 125.0, 12.5, 5.0


def timed_ticks(bundle: Bundle, calls: int) -> np.ndarray:
    """Microseconds of single ticks, with a new phase each."""
    compiled = CompiledBundle(bundle)
    middle = {i.name: 0.5 * (i.low + i.high) for i in bundle.inputs}
    compiled.window(np.array([middle[n] for n in bundle.feature_inputs]))
    inputs, evaluate, clock = compiled.tick_inputs, compiled.evaluate, time.perf_counter_ns
    inputs[:] = [middle[n] for n in bundle.tick_inputs]
    phase = bundle.tick_inputs.index("command_phase_rad")
    took = np.empty(calls)
    for i in range(calls):
        begun = clock()
        inputs[phase] = 0.03 * (i % 200)
        evaluate()
        took[i] = clock() - begun
    return took / 1e3


def timed_windows(bundle: Bundle, count: int = 50) -> np.ndarray:
    """Milliseconds of a second of samples, the features of 5 s and both equations."""
    assert bundle.window is not None
    stream, compiled = StreamingWindow(bundle.window), CompiledBundle(bundle)
    places = [bundle.window.columns.index(n) for n in bundle.feature_inputs]
    rng = np.random.default_rng(1)
    took = []
    for _ in range(count + 6):
        block = rng.normal(size=(2, bundle.window.hop))
        begun = time.perf_counter()
        found = stream.push(block)
        if len(found.values):
            compiled.window(found.values[-1].reshape(-1)[places])
            took.append(time.perf_counter() - begun)
    return 1e3 * np.array(took[1:])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--calls", type=int, default=1_000_000)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--short", action="store_true", help="the same code with little data")
    options = parser.parse_args()
    groups = groups_of(list(virtual_runs(QUICK, virtual_slide("linear"), 0)), "the virtual slide")
    bundle = fitted_tones("virtual-turning", groups, "two-modes", "inverse", 0).bundle
    calls = 2_000 if options.short else options.calls
    took = timed_ticks(bundle, calls)
    windows = timed_windows(bundle, 3 if options.short else 50)
    median = float(np.median(took))
    preempted = took > median + PREEMPTED_US
    found = {
        "calls": calls,
        "p50_us": median,
        "p99_us": float(np.percentile(took, 99)),
        "p99_9_us": float(np.percentile(took, 99.9)),
        "max_us": float(took.max()),
        "budget_us": BUDGET_US,
        "preempted_calls": int(preempted.sum()),
        "preempted_longest_us": float(took[preempted].max()) if preempted.any() else 0.0,
        "longer_than_a_tick": int((took > TICK_US).sum()),
        "max_without_preemption_us": float(took[~preempted].max()),
        "window_p50_ms": float(np.median(windows)),
        "window_max_ms": float(windows.max()),
    }
    if options.json:
        print(json.dumps(found))
        return
    for name, value in found.items():
        print(f"{name:<28} {value:.3f}" if isinstance(value, float) else f"{name:<28} {value}")


if __name__ == "__main__":
    main()
