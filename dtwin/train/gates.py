"""Checks that a model must pass before it may move anything."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from dtwin.features.path_inputs import PATH_INPUT_UNITS, PATH_INPUTS
from dtwin.schema import PLANES
from dtwin.serve.bundle import Bundle
from dtwin.serve.direction import Direction
from dtwin.serve.proof import prove
from dtwin.serve.runtime import CompiledBundle
from dtwin.serve.safety import Guard
from dtwin.train.closed_loop import Evidence
from dtwin.train.dataset import TICK_HZ
from dtwin.train.results import condition_name

_LATENCY_BUDGET_US = 100.0
_MIN_R2 = 0.2
_LEAST_SLOW_R2 = 0.5
# An error of less than so many noise floors need not fall, it must only not grow.
_ERROR_FLOORS = 3.0
_LEAST_SHARE = 0.5
"""Of the range that is served, which evidence must have gone over."""


@dataclass(frozen=True)
class Verdict:
    """What one gate says."""

    gate: str
    passed: bool
    reason: str


def offline_gates(bundle: Bundle, metrics: Mapping[str, float]) -> list[Verdict]:
    """Judge a bundle by everything that needs no motion."""
    return [
        _held_out(metrics),
        _no_slice_worse(metrics),
        _sign_and_frame(bundle),
        bounded_output(bundle),
        _contract(bundle),
        latency_gate(metrics),
    ]


def slow_gates(bundle: Bundle, metrics: Mapping[str, float], left_out: str, said: str) -> list[Verdict]:
    """Judge a bundle of what heat moves by everything that needs no other campaign.

    ``metrics``: what training logged: scores of what was left out, latency.
    ``left_out``, ``said``: what was left out, as scores name it, and in words.
    """
    r2 = metrics.get(f"leave_{left_out}_out.r2", float("nan"))
    worst = metrics.get(f"leave_{left_out}_out.worst_slice_ratio", float("inf"))
    return [
        Verdict(f"held-out {said}", r2 >= _LEAST_SLOW_R2, f"R² {r2:z.3f}; at least {_LEAST_SLOW_R2}"),
        Verdict(
            "no slice worse than no correction",
            worst < 1.0,
            f"the worst of the {said} keeps {100 * worst:z.0f} % of its error",
        ),
        bounded_output(bundle),
        vectors_proved(bundle),
        latency_gate(metrics),
    ]


def evidence_gate(evidence: Evidence, bundle: Bundle, *, real: bool) -> list[Verdict]:
    """Judge closed-loop evidence.

    ``evidence``: as it was computed from runs.
    ``bundle``: the bundle that it must belong to.
    ``real``: whether the machine is real, which virtual evidence cannot speak for.
    """
    conditions = evidence.conditions
    worse = [c for c in conditions if c["worse"]]
    better = [c for c in conditions if c["better"]]
    counted = [c for c in conditions if c in better or _errs(c)]
    spared = len(conditions) - len(counted)
    same = evidence.model_sha256 == bundle.model_sha256 and evidence.machine == bundle.machine
    kind_fits = evidence.kind == "real" or not real
    return [
        Verdict("evidence belongs to this bundle", same, evidence.model_sha256[:12]),
        Verdict("evidence is of this kind of machine", kind_fits, f"{evidence.kind} evidence"),
        Verdict(
            "no condition worse",
            not worse,
            "none beyond its 95 % interval" if not worse else ", ".join(map(condition_name, worse)),
        ),
        Verdict(
            "error falls",
            len(better) > len(counted) / 2,
            f"{len(better)} of {len(counted)} conditions better beyond their 95 % intervals"
            + (f", {spared} below three noise floors" if spared else ""),
        ),
        *_covered(evidence, bundle),
    ]


def _covered(evidence: Evidence, bundle: Bundle) -> list[Verdict]:
    """Judge whether runs with the correction went over most of each input that the control commands and they hold."""
    verdicts = []
    for one in bundle.inputs:
        if one.source == "controller" and one.name in evidence.reached:
            low, high = evidence.reached[one.name]
            share = (min(high, one.high) - max(low, one.low)) / (one.high - one.low)
            told = f"{one.name} from {low:g} to {high:g}, served from {one.low:g} to {one.high:g}"
            verdicts.append(Verdict("evidence covers what is served", share >= _LEAST_SHARE, told))
    return verdicts


def _errs(condition: Mapping[str, Any]) -> bool:
    """Tell whether there is much to correct; what lies near the noise floor need not fall."""
    return bool(condition["before_um"] > _ERROR_FLOORS * condition["floor_um"])


def _held_out(metrics: Mapping[str, float]) -> Verdict:
    r2_of = {group: metrics.get(f"leave_{group}_out.r2", float("nan")) for group in ("feed_mm_min", "radius_mm")}
    told = ", ".join(
        f"{group} out: " + ("not tested" if np.isnan(r2) else f"R² {r2:z.3f}") for group, r2 in r2_of.items()
    )
    passed = all(np.isnan(r2) or r2 >= _MIN_R2 for r2 in r2_of.values())
    passed = passed and r2_of["feed_mm_min"] >= _MIN_R2
    return Verdict("held-out conditions", passed, f"{told}; at least {_MIN_R2}")


def _no_slice_worse(metrics: Mapping[str, float]) -> Verdict:
    """Judge conditions whose feed was left out; those whose radius was are told only."""
    by_feed, by_radius = (
        metrics.get(f"leave_{group}_out.worst_slice_ratio", float("nan")) for group in ("feed_mm_min", "radius_mm")
    )
    told = f"worst condition with its feed left out keeps {100 * by_feed:z.0f} % of its error"
    if not np.isnan(by_radius):
        told += f"; with its radius left out {100 * by_radius:z.0f} %, not judged"
    return Verdict("no slice worse than no correction", by_feed < 1.0, told)


def _sign_and_frame(bundle: Bundle) -> Verdict:
    """A positive predicted radial error must be answered inwards, in every plane."""
    direction = Direction(bundle.outputs)
    outward_sign = -1.0 if bundle.outputs[0].role == "error" else 1.0
    worst = 1.0
    for plane_id in range(len(PLANES)):
        for angle in np.linspace(0.1, 6.2, 9):
            vector = direction.apply(np.ones(len(bundle.outputs)), float(angle), float(plane_id))
            outward = np.zeros(3)
            outward[plane_id % 3], outward[(plane_id + 1) % 3] = np.cos(angle), np.sin(angle)
            length = max(float(np.linalg.norm(vector)), 1e-12)
            worst = min(worst, outward_sign * float(vector @ outward) / length)
    radial = all(output.frame == "path_radial" for output in bundle.outputs)
    passed = not radial or worst > 1.0 - 1e-9
    return Verdict("sign and frame", passed, f"cosine to the inward radius {worst:z.6f}")


def vectors_proved(bundle: Bundle) -> Verdict:
    """Evaluate the bundle's own test vectors again."""
    try:
        prove(bundle)
    except Exception as error:  # whatever it is, it is the reason
        return Verdict("train and serve agree", False, f"test vectors: {error}")
    return Verdict("train and serve agree", True, "test vectors proved, bit for bit")


def bounded_output(bundle: Bundle) -> Verdict:
    """Whatever comes in, what goes out stays inside the clamp."""
    rng = np.random.default_rng(7)
    low = np.array([i.low for i in bundle.inputs if i.source != "feature"])
    high = np.array([i.high for i in bundle.inputs if i.source != "feature"])
    compiled = CompiledBundle(bundle)
    guard = Guard(bundle.safety, low, high)
    largest = raw = 0.0
    for scale in (1.0, 3.0, 1e6):
        for _ in range(300):
            middle, half = 0.5 * (low + high), 0.5 * (high - low) * scale
            inputs = middle + half * rng.uniform(-1.0, 1.0, low.size)
            wanted = np.zeros(3)
            wanted[: len(bundle.outputs)] = compiled.tick(inputs)
            safe = guard.step(wanted, inputs, age_s=0.0, elapsed_s=0.002)
            length = float(np.linalg.norm(safe))
            if not np.isfinite(length):
                return Verdict("bounded output", False, "not finite after the guard")
            largest = max(largest, length)
            raw = max(raw, float(np.max(np.abs(wanted)))) if scale == 1.0 else raw
    passed = largest <= bundle.safety.clamp_um * (1 + 1e-9)
    return Verdict(
        "bounded output",
        passed,
        f"up to {raw:z.0f} µm inside the box, {largest:z.0f} µm after a clamp of "
        f"{bundle.safety.clamp_um:z.0f} µm whatever comes in",
    )


def _contract(bundle: Bundle) -> Verdict:
    problems = [
        i.name
        for i in bundle.inputs
        if i.source == "path" and (PATH_INPUT_UNITS.get(i.name) != i.unit or i.rate_hz != TICK_HZ)
    ]
    problems += [i.name for i in bundle.inputs if i.source == "path" and i.name not in PATH_INPUTS]
    proved = vectors_proved(bundle)
    if not proved.passed:
        return proved
    return Verdict(
        "train and serve agree",
        not problems,
        ", ".join(problems) or f"{len(bundle.inputs)} inputs at {TICK_HZ:g} Hz, test vectors proved",
    )


def latency_gate(metrics: Mapping[str, float]) -> Verdict:
    """Compare the time of one evaluation with its budget."""
    p99 = metrics.get("latency_p99_us", float("inf"))
    return Verdict("latency", p99 <= _LATENCY_BUDGET_US, f"p99 {p99:z.2f} µs of {_LATENCY_BUDGET_US:g}")
