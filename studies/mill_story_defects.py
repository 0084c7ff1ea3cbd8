"""Defects that the source thesis's programs had, as switches on the right correction."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from dtwin.kinds.circular.freeze import wrong_way
from dtwin.machines.mill import Correction
from dtwin.machines.mill_drive import STEP_S
from dtwin.progress import Progress, silent
from dtwin.schema import Floats
from dtwin.serve.bundle import Bundle
from dtwin.serve.graph import Node
from dtwin.serve.proof import with_vectors
from dtwin.serve.safety import REASONS, Guard
from dtwin.train.gates import evidence_gate, offline_gates
from studies.mill_story_session import LaterSession, Way, later_session
from studies.thesis_mill import MACHINE

QUANTUM_UM = 250.0 / 256
STALE_S = 1.0
OTHER_RATE_HZ = 1651.0
RIGHT = "as it should be"
NOT_DONE = (
    "the window of an accelerometer (the correction of this mill has none); "
    "the spread of a sample rate inside one window"
)


def defects(
    bundle: Bundle, metrics: Mapping[str, float], *, seed: int, repeats: int, progress: Progress = silent
) -> list[dict[str, Any]]:
    """Apply each defect to a correction, and say which gate or alarm catches it.

    ``bundle``: the correction as it should be.
    ``metrics``: what its training logged, for the offline gates.
    ``seed``: of the session in which all of them are measured.
    ``repeats``: of every way, feed and direction.
    ``progress``: called with (done, total, what).
    Returns by defect: ``defect``, ``caught`` (names), ``ratio`` of the error with it to the error without any
    correction, mean over the feeds; None when it is caught before it moves.
    """
    ways = {
        RIGHT: Way(bundle),
        "sign flipped": Way(wrong_way(bundle)),
        "axes swapped": Way(bundle, _changed(lambda mm: mm[::-1])),
        f"{STALE_S:g} s old, stamped as new": Way(bundle, _changed(_late)),
        f"8-bit output, {QUANTUM_UM:z.2f} µm": Way(bundle, _changed(_rounded)),
        "a Gaussian term that never fires": Way(with_dead_term(bundle)),
    }
    session = later_session(ways, seed=seed, repeats=repeats, progress=progress)
    out = [_measured(name, way.bundle, metrics, session) for name, way in ways.items()]
    out.append({"defect": f"{STALE_S:g} s old, and its age known", "ratio": None, "caught": _stale(bundle)})
    other = replace(bundle, inputs=tuple(replace(i, rate_hz=OTHER_RATE_HZ) for i in bundle.inputs))
    out.append({"defect": f"trained at {OTHER_RATE_HZ:g} Hz", "ratio": None, "caught": _refusing(other, metrics)})
    return out


def with_dead_term(bundle: Bundle) -> Bundle:
    """Return the bundle with a Gaussian of the path angle added that is zero everywhere in reach.

    ``bundle``: from ``twin_bundle``.
    """
    graph = bundle.tick_graph
    nodes = list(graph.nodes)

    def add(node: Node) -> int:
        nodes.append(node)
        return len(nodes) - 1

    place = next(k for k, n in enumerate(nodes) if n.op == "input" and n.name == "direction_sign")
    far = add(Node("sub", (place, add(Node("const", value=600.0)))))
    falls = add(Node("neg", (add(Node("square", (far,))),)))
    gauss = add(Node("exp", (falls,)))
    (name, number), *_ = graph.outputs.items()
    total = add(Node("add", (number, gauss)))
    changed = replace(graph, nodes=tuple(nodes), outputs={**graph.outputs, name: total})
    return with_vectors(replace(bundle, tick_graph=changed), 1)


def _measured(name: str, bundle: Bundle, metrics: Mapping[str, float], session: LaterSession) -> dict[str, Any]:
    found = session.evidence(name, bundle)
    verdicts = evidence_gate(found, bundle, real=False)
    caught = [v.gate for v in verdicts if not v.passed]
    ratio = np.mean([c["after_um"] / c["before_um"] for c in found.conditions])
    return {"defect": name, "ratio": float(ratio), "caught": _refusing(bundle, metrics) + caught}


def _refusing(bundle: Bundle, metrics: Mapping[str, float]) -> list[str]:
    return [v.gate for v in offline_gates(bundle, metrics) if not v.passed]


def _stale(bundle: Bundle) -> list[str]:
    """Return the guard's own word for a state that is too old."""
    low, high = bundle.box
    guard = Guard(bundle.safety, low, high)
    sent = guard.step(np.ones(3), 0.5 * (low + high), age_s=STALE_S, elapsed_s=0.002)
    return [f"guard of {MACHINE}: {REASONS[guard.reason]}"] if not sent.any() else []


def _changed(change: Callable[[Floats], Floats]) -> Callable[[Correction], Correction]:
    def wrap(inner: Correction) -> Correction:
        return lambda test, command: np.ascontiguousarray(change(inner(test, command)))

    return wrap


def _late(mm: Floats) -> Floats:
    steps = round(STALE_S / STEP_S)
    return np.concatenate([np.zeros((2, steps)), mm[:, :-steps]], axis=1)


def _rounded(mm: Floats) -> Floats:
    quantum_mm = QUANTUM_UM / 1000.0
    return np.asarray(np.round(mm / quantum_mm) * quantum_mm)


def uncaught(found: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the defects that no gate and no alarm caught.

    ``found``: from ``defects``.
    """
    return [d["defect"] for d in found if not d["caught"] and d["defect"] != RIGHT]
