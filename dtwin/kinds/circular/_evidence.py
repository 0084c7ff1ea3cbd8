"""Circles of the virtual cobot with a correction, without it and with an oracle, interleaved; also later, against a champion."""

from __future__ import annotations

import math
import os
from collections import defaultdict
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from datetime import timedelta
from functools import lru_cache, partial
from typing import Any

import numpy as np

from dtwin.acquire.virtual import EPOCH, run_of
from dtwin.kinds.machine import EvidenceRequest
from dtwin.machines.cobot import CircleCondition, CobotRecording, RunTicks, VirtualCobot
from dtwin.plan import DEFAULT_EVIDENCE, EvidencePlan, plan_within
from dtwin.processes import end_with, processors
from dtwin.progress import Progress, silent
from dtwin.schema import Direction, Floats, Run
from dtwin.serve.bundle import Bundle
from dtwin.serve.decision import Decision
from dtwin.serve.interface import SafetyLimits
from dtwin.serve.lockstep import serve_lockstep
from dtwin.serve.runtime import CompiledBundle
from dtwin.statistics import rms
from dtwin.train.evidence_record import newest
from dtwin.train.oracle import TICK_S, MeasuredWays, best_offsets, follow, guard_shares, numbered
from dtwin.train.results import CONDITIONS_FILE, condition_name
from dtwin.train.still_helps import CheckedRun

WAYS = ("uncompensated", "compensated", "oracle")
_APART = timedelta(minutes=5)


def measured_circles(
    bundle: Bundle, *, seed: int, tcp_mm: Floats, plan: EvidencePlan = DEFAULT_EVIDENCE, progress: Progress = silent
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
    with ProcessPoolExecutor(processors(), initializer=end_with, initargs=(os.getpid(),)) as pool:
        for done, condition_runs in enumerate(pool.map(_measure_condition, jobs), start=1):
            plane, radius, feed = plan.conditions[done - 1]
            condition = {"plane": plane, "radius_mm": radius, "feed_mm_min": feed}
            counts = []
            for way, run, guard in condition_runs:
                ways["oracle" if way == "oracle" else "measured"].append(run)
                counts += [guard] if way == "compensated" else []
            acted[condition_name(condition)] = guard_shares(counts)
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


_DIRECTIONS: tuple[Direction, Direction] = ("CCW", "CW")


class CorrectedCircles:
    """Circles of the virtual cobot in lock-step, by three ways: nothing, a bundle, or the best that is found.

    What the machine does is the same in every mounting and repeat: each program runs once, and the instruments record
    it every time.

    ``bundle``: what is served; the oracle takes its limits.
    ``tcp_mm`` (3,): tool centre point.
    """

    def __init__(self, cobot: VirtualCobot, bundle: Bundle, tcp_mm: Floats) -> None:
        self._cobot, self._bundle, self._tcp_mm = cobot, bundle, tcp_mm
        self._ran: dict[tuple[CircleCondition, str], tuple[RunTicks, dict[str, int]]] = {}

    def measure(
        self, condition: CircleCondition, setup: str, repeat: int, way: str
    ) -> tuple[CobotRecording, dict[str, int]]:
        """Return the recording of one circle, and how often each guard acted.

        ``condition``, ``setup``, ``repeat``: what is run, in which mounting of the bar, which repeat.
        ``way``, one of "uncompensated", "compensated", "oracle": nothing, the bundle, or the best that is found with
        the truth known (:mod:`dtwin.train.oracle`).
        """
        condition = condition.standard()
        if (condition, way) not in self._ran:
            self._ran[condition, way] = self._run(condition, way)
        ticks, acted = self._ran[condition, way]
        return self._cobot.recording_of(condition, self._cobot.plan(condition), ticks, setup, repeat), acted

    def _run(self, condition: CircleCondition, way: str) -> tuple[RunTicks, dict[str, int]]:
        if way == "uncompensated":
            return self._cobot.run(self._cobot.plan(condition)), {}
        controller = self._cobot.controller(condition, setup="", repeat=1)
        if way == "compensated":
            acted = serve_lockstep(Decision(CompiledBundle(self._bundle), self._tcp_mm), controller).reasons
        else:
            both = [replace(condition, direction=direction) for direction in _DIRECTIONS]
            offsets = _best_of_both(self._cobot, both[0], self._bundle.safety)[both.index(condition)]
            acted = follow(controller, offsets, self._bundle.safety)[1]
        return controller.ticks(), acted


@lru_cache(maxsize=8)
def _best_of_both(cobot: VirtualCobot, condition: CircleCondition, safety: SafetyLimits) -> list[Floats]:
    """Return the oracle's offsets of both directions; the same for every mounting and repeat."""
    begun = [
        partial(cobot.controller, replace(condition, direction=way), setup="oracle", repeat=1) for way in _DIRECTIONS
    ]
    centre = cobot.centre_mm(condition.radius_mm)
    return best_offsets(begun, centre, cobot.parameters.controller, safety)


def evaluate_circle(recording: CobotRecording, direction: str) -> dict[str, Any]:
    """Return ``direction``, ``angle_rad`` and ``deviation_um`` of a recording's measured arc."""
    start, end = recording.window
    arc = 2.0 * math.pi if recording.condition.plane == "XY" else math.pi
    turned = np.arange(end - start) / (end - start) * arc
    return {
        "direction": direction,
        "angle_rad": turned if direction == "CCW" else arc - turned,
        "deviation_um": recording.deviation_mm[start:end] * 1000.0,
    }


def rms_per_run(runs: Sequence[Mapping[str, Any]]) -> Floats:
    """Return each run's RMS after the set-up's centre and radius, common to these runs.

    ``runs``: from ``evaluate_circle``; each gets its remainder under ``rest_um``.
    Returns (runs,): in um.
    """
    angle = np.concatenate([r["angle_rad"] for r in runs])
    value = np.concatenate([r["deviation_um"] for r in runs])
    basis = np.column_stack([np.ones_like(angle), np.cos(angle), np.sin(angle)])
    rest = value - basis @ np.linalg.lstsq(basis, value, rcond=None)[0]
    parts = np.split(rest, np.cumsum([len(r["angle_rad"]) for r in runs])[:-1])
    for run, part in zip(runs, parts, strict=True):
        run["rest_um"] = part  # type: ignore[index]
    return np.array([rms(part) for part in parts])


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
