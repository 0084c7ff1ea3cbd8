"""Circles of the virtual cobot with a correction, without it and with an oracle, interleaved."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from datetime import timedelta
from typing import Any

import numpy as np

from dtwin.acquire.virtual import EPOCH, run_of
from dtwin.kinds.circular._circles import CorrectedCircles
from dtwin.machines.cobot import CircleCondition, VirtualCobot
from dtwin.plan import DEFAULT_EVIDENCE, EvidencePlan
from dtwin.processors import processors
from dtwin.progress import Progress
from dtwin.schema import Floats, Run
from dtwin.serve.bundle import Bundle
from dtwin.train.measured_ways import MeasuredWays, guard_shares, numbered
from dtwin.train.oracle import TICK_S
from dtwin.train.results import condition_name

WAYS = ("uncompensated", "compensated", "oracle")
_APART = timedelta(minutes=5)


def measured_circles(
    bundle: Bundle,
    *,
    seed: int,
    tcp_mm: Floats,
    plan: EvidencePlan = DEFAULT_EVIDENCE,
    progress: Progress | None = None,
) -> MeasuredWays:
    """Measure compensated, uncompensated and oracle circles on the virtual cobot.

    Runs in lock-step on the machine clock: the controller advances a tick when that tick's
    correction has arrived. The three ways alternate inside every set-up, which is not one of
    those that were trained in. The oracle is the best correction found with the truth known,
    subject to the same guard, delay and lag as the bundle.

    ``seed``: seed of the machine that was trained on.
    ``tcp_mm`` (3,): tool centre point.
    """
    jobs = [(bundle.to_dict(), seed, tcp_mm.tolist(), condition, plan.repeats) for condition in plan.conditions]
    ways: dict[str, list[Run]] = {"measured": [], "oracle": []}
    acted: dict[str, dict[str, float]] = {}
    with ProcessPoolExecutor(processors()) as pool:
        for done, found in enumerate(pool.map(_measure_condition, jobs), start=1):
            plane, radius, feed = plan.conditions[done - 1]
            condition = {"plane": plane, "radius_mm": radius, "feed_mm_min": feed}
            counts = []
            for way, run, guard in found:
                ways["oracle" if way == "oracle" else "measured"].append(run)
                counts += [guard] if way == "compensated" else []
            acted[condition_name(condition)] = guard_shares(counts)
            if progress is not None:
                progress(done, len(jobs), f"{plane} R{radius:g} F{feed:g}")
    controller = VirtualCobot(seed=seed).parameters.controller
    return MeasuredWays(
        runs=numbered(
            replace(r, meta=replace(r.meta, started=(EPOCH + number * _APART).isoformat()))
            for number, r in enumerate(ways["measured"], start=1)
        ),
        clock="machine clock (lock-step, 500 Hz)",
        delays={
            "actuator_delay_s": controller.actuator_delay_s,
            "actuator_lag_s": controller.actuator_lag_s,
            "transport_s": TICK_S,
        },
        oracle=tuple(ways["oracle"]),
        acted=acted,
        trained=plan.trained,
    )


def _measure_condition(job: tuple[Any, ...]) -> list[tuple[str, Run, dict[str, int]]]:
    content, seed, tcp, (plane, radius, feed), repeats = job
    bundle = Bundle.from_dict(content)
    circles = CorrectedCircles(VirtualCobot(seed=seed), bundle, np.array(tcp))
    measured: list[tuple[str, Run, dict[str, int]]] = []
    setup = f"evidence-{plane}-{radius:g}"
    for _ in range(repeats):
        for way in WAYS:
            for direction in ("CCW", "CW"):
                condition = CircleCondition(plane, radius, feed, direction)
                recording, acted = circles.measure(condition, setup, 101 + len(measured), way)
                run = run_of(recording, "e", plane, EPOCH)
                correction = bundle.model_sha256 if way == "compensated" else ""
                meta = replace(run.meta, correction=correction)
                measured.append((way, replace(run, meta=meta, signals=()), acted))
    return measured
