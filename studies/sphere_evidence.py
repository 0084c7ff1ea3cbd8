"""Three circles on a sphere with and without correction: before, after, and an oracle."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dtwin.machines._instrument_record import RunTicks
from dtwin.machines.cobot import VirtualCobot
from dtwin.machines.controller import CobotController
from dtwin.machines.motion import MotionPlan
from dtwin.progress import Progress, silent
from dtwin.schema import Floats
from dtwin.serve.bundle import Bundle
from dtwin.serve.decision import Decision
from dtwin.serve.lockstep import serve_lockstep
from dtwin.serve.runtime import CompiledBundle
from dtwin.statistics import rms, t_quantile
from dtwin.train.oracle import best_offsets, follow
from studies.machines.sphere_path import RADIUS_MM, SphereRun, sphere_controller, sphere_plan, sphere_run
from studies.sphere_model import mounting_terms

WAYS = ("uncompensated", "compensated", "oracle")


@dataclass(frozen=True)
class FeedResult:
    """Before and after at one feed, the run as unit.

    ``feed_mm_min``: programmed feed.
    ``trained``: whether the model was fitted at this feed.
    ``rms_um``, ``raw_mae_um``: by way, every run: RMS with one centre and one length for all runs of the way, and the
    mean absolute deviation as measured, mounting included.
    ``acted``: how often each reason of the guard held, while compensated.
    """

    feed_mm_min: float
    trained: bool
    rms_um: dict[str, list[float]]
    raw_mae_um: dict[str, list[float]]
    acted: dict[str, int]

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping with the derived figures."""
        before, after, oracle = (np.array(self.rms_um[way]) for way in WAYS)
        growth, half = difference(before, after)
        return {
            **vars(self),
            "before_um": float(before.mean()),
            "after_um": float(after.mean()),
            "oracle_um": float(oracle.mean()),
            "before_half_width_um": half_width(before),
            "after_half_width_um": half_width(after),
            "change_um": growth,
            "change_half_width_um": half,
            "reduction": 1.0 - float(after.mean() / before.mean()),
            "share_of_oracle": share_of_oracle(before.mean(), after.mean(), oracle.mean()),
            "worse": growth > half,
        }


def sphere_evidence(
    bundle: Bundle,
    cobot: VirtualCobot,
    *,
    tcp_mm: Floats,
    feeds_mm_min: Sequence[float],
    trained_mm_min: Sequence[float],
    repeats: int,
    setup: str,
    progress: Progress = silent,
) -> list[FeedResult]:
    """Measure the three circles at every feed without, with, and with an oracle's correction.

    Machine clock: controller and serving code in lock-step. What does not repeat on this machine
    acts between tool and bar, so a way is driven once and recorded ``repeats`` times.

    ``bundle``: what is served.
    ``cobot``: the machine.
    ``tcp_mm``, (3,): tool centre point.
    ``feeds_mm_min``, ``trained_mm_min``: feeds to run, and those that the bundle was fitted at.
    ``repeats``: Runs of each way.
    ``setup``: mounting of the bar, one that no fit has seen.
    ``progress``: called with (done, total, what).
    """
    out = []
    for done, feed in enumerate(feeds_mm_min, start=1):
        plan = sphere_plan(cobot, feed)
        plain = cobot.run(plan)
        served, acted = _served(bundle, cobot, plan, feed, tcp_mm)
        ticks = {"uncompensated": plain, "compensated": served, "oracle": _oracle(bundle, cobot, plan, feed)}
        rms: dict[str, list[float]] = {}
        raw: dict[str, list[float]] = {}
        for number, way in enumerate(WAYS):
            runs = [
                sphere_run(cobot, feed, ticks[way], setup=setup, repeat=100 + 50 * number + k) for k in range(repeats)
            ]
            rms[way] = remainders_um(runs)
            raw[way] = [float(np.abs(r.deviation_um).mean()) for r in runs]
        out.append(FeedResult(feed, feed in trained_mm_min, rms, raw, acted))
        progress(done, len(feeds_mm_min), f"F{feed:g}")
    return out


def remainders_um(runs: Sequence[SphereRun]) -> list[float]:
    """Return every run's RMS after one centre and one length that the runs share."""
    terms = np.concatenate([mounting_terms(r) for r in runs])
    value = np.concatenate([r.deviation_um for r in runs])
    rest = value - terms @ np.linalg.lstsq(terms, value, rcond=None)[0]
    parts = np.split(rest, np.cumsum([len(r.deviation_um) for r in runs])[:-1])
    return [rms(part) for part in parts]


def half_width(values: Floats) -> float:
    """Return the half width of the 95 % interval of a mean."""
    n = len(values)
    if n < 2:
        return math.inf
    return t_quantile(0.975, n - 1) * float(np.std(values, ddof=1)) / math.sqrt(n)


def difference(before: Floats, after: Floats) -> tuple[float, float]:
    """Return the mean of ``after`` minus that of ``before``, and its 95 % half width (Welch)."""
    parts = [float(np.var(v, ddof=1)) / len(v) for v in (before, after)]
    spread = sum(parts)
    if spread <= 0.0:
        return float(after.mean() - before.mean()), 0.0
    freedom = spread**2 / sum(p**2 / (len(v) - 1) for p, v in zip(parts, (before, after), strict=True))
    wide = t_quantile(0.975, freedom) * math.sqrt(spread)
    return float(after.mean() - before.mean()), wide


def share_of_oracle(before_um: float, after_um: float, oracle_um: float) -> float:
    """Return the reduction as a share of the oracle's; NaN when the oracle removes nothing."""
    possible = before_um - oracle_um
    return float((before_um - after_um) / possible) if possible > 0.0 else math.nan


def _served(
    bundle: Bundle, cobot: VirtualCobot, plan: MotionPlan, feed: float, tcp_mm: Floats
) -> tuple[RunTicks, dict[str, int]]:
    controller = sphere_controller(cobot, plan, feed)
    status = serve_lockstep(Decision(CompiledBundle(bundle), tcp_mm), controller)
    return controller.ticks(), status.reasons


def _oracle(bundle: Bundle, cobot: VirtualCobot, plan: MotionPlan, feed: float) -> RunTicks:
    """Return the run of the best correction that is found with the truth known, under the same guard."""

    def begun() -> CobotController:
        return sphere_controller(cobot, plan, feed)

    centre = cobot.centre_mm(RADIUS_MM)
    (offsets,) = best_offsets([begun], centre, cobot.parameters.controller, bundle.safety)
    return follow(begun(), offsets, bundle.safety)[0].ticks()
