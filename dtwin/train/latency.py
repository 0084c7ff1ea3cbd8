"""Time of one row, on what serving would really run."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from dtwin.schema import Floats
from dtwin.serve.bundle import Bundle
from dtwin.serve.runtime import CompiledBundle
from dtwin.train.results import Candidate, Latency

_BUDGET_NS, _ROUNDS = 1e8, 3
_EDGES_US = (0.25, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 1000.0)


def bundle_latency(bundle: Bundle, calls: int = 20_000) -> Latency:
    """Time single evaluations of a compiled bundle, as the loop does them."""
    compiled = CompiledBundle(bundle)
    low = np.array([i.low for i in bundle.inputs if i.source != "feature"])
    high = np.array([i.high for i in bundle.inputs if i.source != "feature"])
    middle = 0.5 * (low + high)
    compiled.tick(middle)
    return _timed(compiled.evaluate, calls, "bundle tick")


def latency_of(candidate: Candidate) -> Latency | None:
    """Time a candidate as it would be served: its bundle, else its ONNX model; None where it has neither."""
    if candidate.bundle is not None:
        return bundle_latency(Bundle.from_dict(candidate.bundle))
    return None if candidate.onnx is None else _onnx_latency(candidate.onnx)


def onnx_of(model: Any, width: int) -> bytes | None:
    """Return a fitted scikit-learn model of so many inputs as serialised ONNX; None when it cannot be converted."""
    from skl2onnx import to_onnx

    try:
        return bytes(to_onnx(model, np.zeros((1, width), np.float32), target_opset=17).SerializeToString())
    except (RuntimeError, NotImplementedError, ValueError):
        return None


def _onnx_latency(model: bytes) -> Latency:
    """Time one row, of zeros, of a serialised ONNX model."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.log_severity_level = 3
    session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    wanted = session.get_inputs()[0]
    row = np.zeros((1, wanted.shape[1]), np.float32)
    return _timed(lambda: session.run(None, {wanted.name: row}), 2000, "onnxruntime")


def _timed(call: Callable[[], Any], calls: int, what: str) -> Latency:
    """Time calls in rounds, and tell the round that other work on the computer disturbed least."""
    # A slow model is not worth minutes of timing.
    each_ns = float(_spent_ns(call, 20).min())
    calls = int(min(calls, max(25, _BUDGET_NS / max(each_ns, 1.0))))
    rounds = [_spent_ns(call, calls) for _ in range(_ROUNDS)]
    spent = min(rounds, key=lambda taken: float(np.percentile(taken, 99)))
    clock = time.perf_counter_ns
    reading_ns = min(-(clock() - clock()) for _ in range(100))
    spent_us = (spent - reading_ns) / 1000.0
    counts = np.histogram(spent_us, bins=[0.0, *_EDGES_US, np.inf])[0]
    edges = [*_EDGES_US, float(spent_us.max())]
    return Latency(
        p50_us=float(np.percentile(spent_us, 50)),
        p99_us=float(np.percentile(spent_us, 99)),
        calls=calls,
        what=what,
        histogram_us=tuple((float(e), int(c)) for e, c in zip(edges, counts, strict=True)),
    )


def _spent_ns(call: Callable[[], Any], calls: int) -> Floats:
    clock = time.perf_counter_ns
    spent = np.empty(calls)
    for i in range(calls):
        begun = clock()
        call()
        spent[i] = clock() - begun
    return spent
