"""Circles with and without a champion on the virtual cobot, in random order."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np

from dtwin.kinds.circular._circles import CorrectedCircles, evaluate_circle, rms_per_run
from dtwin.kinds.machine import EvidenceRequest
from dtwin.machines.cobot import CircleCondition, VirtualCobot
from dtwin.plan import plan_within
from dtwin.train.evidence_record import newest
from dtwin.train.recheck import CheckedRun
from dtwin.train.results import CONDITIONS_FILE


def checked_circles(request: EvidenceRequest, blocks: int, cobot: VirtualCobot) -> list[CheckedRun]:
    """Measure circles with and without a bundle.

    Every block holds each condition in both directions, with and without, in an order of its own.
    The bar stays mounted; centre and radius of a set-up are fitted for each way as in the
    evidence for promotion.

    ``blocks``: passes over all of it.
    ``cobot``: the machine as it is now.
    """
    seed = request.seed
    tcp_mm = np.asarray(request.geometry.get("tcp_mm", [0.0, 0.0, 0.0]), float)
    rng = np.random.default_rng([seed, 83])
    jobs = [
        (condition, direction, way)
        for condition in _conditions(request)
        for direction in ("CCW", "CW")
        for way in ("uncompensated", "compensated")
    ]
    circles = CorrectedCircles(cobot, request.bundle, tcp_mm)
    by_condition: dict[Any, list[dict[str, Any]]] = defaultdict(list)
    order = [(block, jobs[i]) for block in range(blocks) for i in rng.permutation(len(jobs))]
    for number, (block, ((plane, radius, feed), direction, way)) in enumerate(order):
        recording, _ = circles.measure(
            CircleCondition(plane, radius, feed, direction),
            f"recheck-{seed}-{plane}-{radius:g}",
            1000 * (seed + 1) + number,
            way,
        )
        run = evaluate_circle(recording, direction) | {"block": block}
        by_condition[(plane, radius, feed), way].append(run)
        if request.progress is not None:
            request.progress(number + 1, len(order), f"{plane} R{radius:g} F{feed:g}, {way}")
    return [
        CheckedRun(plane, radius, feed, run["direction"], run["block"], way == "compensated", float(rms))
        for ((plane, radius, feed), way), runs in by_condition.items()
        for run, rms in zip(runs, rms_per_run(runs), strict=True)
    ]


def _conditions(request: EvidenceRequest) -> list[tuple[str, float, float]]:
    """Return the circles of its promotion, or without evidence those that it was trained for."""
    kept = newest(request.registry, request.version)
    if kept is not None:
        rows = kept.content["conditions"]
        return [(str(c["plane"]), float(c["radius_mm"]), float(c["feed_mm_min"])) for c in rows]
    trained = request.registry.read_json(request.version, CONDITIONS_FILE)
    return list(plan_within([(p, float(r), float(f)) for p, r, f in trained]).conditions)
