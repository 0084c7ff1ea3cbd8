"""Closed-loop evidence: compensated against uncompensated circles, interleaved."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dtwin.machines.cobot import CircleCondition, VirtualCobot
from dtwin.schema import Floats
from dtwin.serve.bundle import Bundle
from dtwin.train.circles import TICK_S, evaluate_circle, rms_per_run, run_circle

Progress = Callable[[int, int, str], None]
# Two-sided 95 % points of Student's t, by degrees of freedom.
_T95 = {1: 12.706, 2: 4.303, 3: 3.182, 4: 2.776, 5: 2.571, 6: 2.447, 7: 2.365, 8: 2.306, 10: 2.228}
WAYS = ("uncompensated", "compensated", "oracle")


@dataclass(frozen=True)
class EvidencePlan:
    """Which circles are measured.

    Attributes
    ----------
    conditions : tuple of (plane, radius_mm, feed_mm_min)
        Each is run in both directions.
    repeats : int
        Repeats per condition, direction and way.
    trained_feeds : tuple of float
        For the report: the others were never trained.
    """

    conditions: tuple[tuple[str, float, float], ...]
    repeats: int = 2
    trained_feeds: tuple[float, ...] = (2000.0, 4000.0, 6000.0)


DEFAULT_PLAN = EvidencePlan(
    tuple(
        (plane, radius, feed)
        for plane, radius in (("XY", 100.0), ("YZ", 150.0), ("ZX", 100.0))
        for feed in (1000.0, 2000.0, 3000.0, 6000.0)
    )
)


@dataclass(frozen=True)
class ConditionResult:
    """Before and after of one condition, over both directions.

    Attributes
    ----------
    plane, radius_mm, feed_mm_min
        The condition.
    trained : bool
        Whether the feed was in the training grid.
    before_um, after_um, oracle_um : float
        RMS of the set-up-corrected radial error, mean over runs.
    before_ci_um, after_ci_um : float
        Half widths of 95 % intervals over runs.
    floor_um : float
        What repeats of the uncompensated circle disagree by.
    n_runs : int
        Runs of each way.
    acted : dict of str to float
        Share of the ticks in which each guard acted, for example ``outside_box``.
    """

    plane: str
    radius_mm: float
    feed_mm_min: float
    trained: bool
    before_um: float
    after_um: float
    oracle_um: float
    before_ci_um: float
    after_ci_um: float
    floor_um: float
    n_runs: int
    acted: Mapping[str, float] = field(default_factory=dict)

    @property
    def reduction(self) -> float:
        """Share of the error that compensation removed."""
        return 1.0 - self.after_um / self.before_um

    @property
    def oracle_reduction(self) -> float:
        """Share that the oracle removed."""
        return 1.0 - self.oracle_um / self.before_um

    @property
    def worse(self) -> bool:
        """Whether compensation made it worse beyond the confidence interval."""
        return self.after_um - self.before_um > math.hypot(self.after_ci_um, self.before_ci_um)

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping with the derived figures."""
        return dict(vars(self)) | {
            "reduction": self.reduction,
            "oracle_reduction": self.oracle_reduction,
            "worse": self.worse,
        }


@dataclass(frozen=True)
class Evidence:
    """Closed-loop evidence for one bundle on one machine.

    Attributes
    ----------
    kind : {"virtual", "real"}
        What was moved.
    clock : str
        Clock that the circles ran on.
    bundle_sha256 : str
        What was served.
    conditions : tuple of ConditionResult
        One per condition.
    delays : dict of str to float
        Modelled delays of the machine clock.
    profiles : dict
        Mean error over the path angle, for plots: ``condition -> way -> direction -> list``.
    """

    kind: str
    clock: str
    bundle_sha256: str
    conditions: tuple[ConditionResult, ...]
    delays: Mapping[str, float]
    profiles: Mapping[str, Any] = field(default_factory=dict)

    def share_of_oracle(self, *, unseen: bool) -> float:
        """Return the reduction as a share of the oracle's, over trained or unseen feeds."""
        chosen = [c for c in self.conditions if c.trained != unseen]
        before = math.sqrt(sum(c.before_um**2 for c in chosen))
        after = math.sqrt(sum(c.after_um**2 for c in chosen))
        oracle = math.sqrt(sum(c.oracle_um**2 for c in chosen))
        return (before - after) / (before - oracle) if before > oracle else math.nan

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping without the profiles."""
        return {
            "kind": self.kind,
            "clock": self.clock,
            "bundle_sha256": self.bundle_sha256,
            "delays": dict(self.delays),
            "share_of_oracle_unseen_feeds": self.share_of_oracle(unseen=True),
            "share_of_oracle_trained_feeds": self.share_of_oracle(unseen=False),
            "conditions": [c.as_dict() for c in self.conditions],
        }


def virtual_evidence(
    bundle: Bundle,
    *,
    seed: int,
    tcp_mm: Floats,
    plan: EvidencePlan = DEFAULT_PLAN,
    workers: int = 2,
    progress: Progress | None = None,
) -> Evidence:
    """Measure compensated, uncompensated and oracle circles on the virtual cobot.

    Runs in lock-step on the machine clock: the controller advances a tick when that tick's
    correction has arrived. The three ways alternate inside every set-up, which is not one of
    those that were trained in. The oracle knows the machine's repeatable error exactly and is
    subject to the same guard, delay and lag as the bundle.

    Parameters
    ----------
    bundle : Bundle
        What to serve.
    seed : int
        Seed of the machine that was trained on.
    tcp_mm : ndarray, shape (3,)
        Tool centre point.
    plan : EvidencePlan
        Circles.
    workers : int
        Processes side by side.
    progress : callable, optional
        Called with (done, total, what).
    """
    jobs = [
        (bundle.to_dict(), seed, tcp_mm.tolist(), plane, radius, feed, plan.repeats)
        for plane, radius, feed in plan.conditions
    ]
    measured = []
    with ProcessPoolExecutor(workers) as pool:
        for done, found in enumerate(pool.map(_measure_condition, jobs), start=1):
            measured.append(found)
            if progress is not None:
                progress(done, len(jobs), "{} R{:g} F{:g}".format(*plan.conditions[done - 1]))
    results, profiles = [], {}
    for (plane, radius, feed), runs in zip(plan.conditions, measured, strict=True):
        results.append(condition_result(plane, radius, feed, feed in plan.trained_feeds, runs))
        profiles[f"{plane} R{radius:g} F{feed:g}"] = {
            way: {
                d: profile_of([r for r in runs[way] if r["direction"] == d]) for d in ("CCW", "CW")
            }
            for way in WAYS
        }
    controller = VirtualCobot(seed=seed).parameters.controller
    return Evidence(
        kind="virtual",
        clock="machine clock (lock-step, 500 Hz)",
        bundle_sha256=bundle.sha256,
        conditions=tuple(results),
        delays={
            "actuator_delay_s": controller.actuator_delay_s,
            "actuator_lag_s": controller.actuator_lag_s,
            "transport_s": TICK_S,
        },
        profiles=profiles,
    )


def plan_within(conditions: Sequence[tuple[str, float, float]], repeats: int = 2) -> EvidencePlan:
    """Return circles in the planes that were trained, at feeds that were and were not.

    Parameters
    ----------
    conditions : sequence of (plane, radius_mm, feed_mm_min)
        What was trained.
    repeats : int
        Repeats per condition, direction and way.
    """
    feeds = sorted({feed for _, _, feed in conditions})
    between = [0.5 * (feeds[0] + feeds[1])] if len(feeds) > 1 else []
    wanted = sorted({0.5 * feeds[0], feeds[0], *between, feeds[-1]})
    circles = []
    for plane in sorted({plane for plane, _, _ in conditions}):
        radii = sorted({radius for p, radius, _ in conditions if p == plane})
        circles += [(plane, radii[(len(radii) - 1) // 2], feed) for feed in wanted]
    return EvidencePlan(tuple(circles), repeats, tuple(feeds))


def _measure_condition(job: tuple[Any, ...]) -> dict[str, list[dict[str, Any]]]:
    content, seed, tcp, plane, radius, feed, repeats = job
    bundle = Bundle.from_dict(content)
    cobot = VirtualCobot(seed=seed)
    found: dict[str, list[dict[str, Any]]] = {way: [] for way in WAYS}
    setup = f"evidence-{plane}-{radius:g}"
    serial = 0
    for _ in range(repeats):
        for way in WAYS:
            for direction in ("CCW", "CW"):
                serial += 1
                condition = CircleCondition(plane, radius, feed, direction)
                recording, acted = run_circle(
                    cobot, bundle, np.array(tcp), condition, setup, 100 + serial, way
                )
                found[way].append(evaluate_circle(recording, direction) | {"acted": acted})
    return found


def condition_result(
    plane: str, radius: float, feed: float, trained: bool, runs: Mapping[str, Sequence[Any]]
) -> ConditionResult:
    """Return before and after of one condition, the run as unit.

    Parameters
    ----------
    plane, radius, feed : str, float, float
        The condition.
    trained : bool
        Whether the feed was trained.
    runs : dict of str to sequence of dict
        By way: ``direction``, ``angle_rad``, ``deviation_um`` and ``acted`` of every run.
    """
    rms = {way: rms_per_run(runs[way]) for way in WAYS}
    before, after = rms["uncompensated"], rms["compensated"]
    return ConditionResult(
        plane=plane,
        radius_mm=radius,
        feed_mm_min=feed,
        trained=trained,
        before_um=float(np.mean(before)),
        after_um=float(np.mean(after)),
        oracle_um=float(np.mean(rms["oracle"])),
        before_ci_um=_half_width(before),
        after_ci_um=_half_width(after),
        floor_um=_floor(runs["uncompensated"]),
        n_runs=len(before),
        acted=_shares([run["acted"] for run in runs["compensated"]]),
    )


def _shares(counts: Sequence[Mapping[str, int]]) -> dict[str, float]:
    total = sum(sum(c.values()) for c in counts)
    names = sorted({name for c in counts for name in c})
    return {n: sum(c.get(n, 0) for c in counts) / total for n in names} if total else {}


def _half_width(values: Floats) -> float:
    n = len(values)
    if n < 2:
        return math.inf
    return _T95.get(n - 1, 2.0) * float(np.std(values, ddof=1)) / math.sqrt(n)


def _floor(runs: Sequence[Mapping[str, Any]]) -> float:
    """Return the pooled standard deviation between repeats of the same direction."""
    squares, freedom = 0.0, 0
    for direction in ("CCW", "CW"):
        grids = np.array([profile_of([r]) for r in runs if r["direction"] == direction])
        if len(grids) > 1:
            squares += float(np.nanmean(np.sum((grids - grids.mean(axis=0)) ** 2, axis=0)))
            freedom += len(grids) - 1
    return math.sqrt(squares / freedom) if freedom else math.nan


def profile_of(runs: Sequence[Mapping[str, Any]], bins: int = 180) -> list[float]:
    """Return the mean error over equal parts of the arc, of runs that were evaluated.

    Parameters
    ----------
    runs : sequence of dict
        With ``angle_rad`` and ``rest_um``.
    bins : int
        Parts of the arc.
    """
    grid = (np.arange(bins) + 0.5) / bins
    rows = []
    for run in runs:
        order = np.argsort(run["angle_rad"])
        angle = run["angle_rad"][order]
        rows.append(np.interp(grid * angle[-1], angle, run["rest_um"][order]))
    return [float(v) for v in np.mean(rows, axis=0)] if rows else []
