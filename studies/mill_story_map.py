"""What the source thesis did on its mill: learn a session, and believe its R²."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dtwin import __version__
from dtwin.config import Home
from dtwin.schema import Floats, Run
from dtwin.serve.builder import Expression, GraphBuilder
from dtwin.serve.bundle import Bundle
from dtwin.serve.bundle_file import create_bundle
from dtwin.serve.graph_code import to_text
from dtwin.serve.interface import Input, Output, Provenance, SafetyLimits
from dtwin.statistics import rms
from dtwin.train.dataset import TICK_HZ
from dtwin.train.latency import bundle_latency
from dtwin.train.registry import RegisteredVersion, Registry
from dtwin.train.results import CONDITIONS_FILE, Candidate, Scores, TrainingReport
from studies.position_map import HARMONICS, fit_position_map, position_waves
from studies.thesis_mill import DIRECTIONS, FEEDS_MM_MIN, MACHINE, PLANE, RADIUS_MM, RUNS_OF_A_FEED

NAME = "map-of-one-session"
_FARTHEST_RAD = 1e4
_CLAMP_UM = 100.0
Weights = Mapping[str, Floats]


@dataclass(frozen=True)
class LearnedSession:
    """A map of positions, learned as the thesis learned.

    ``weights``: by direction, of ``position_waves``.
    ``rows``: by feed: ``r2`` on the run that was left out, its error before and after.
    ``mounting_share``: share of the mean square of the map that is centre and radius of the mounting.
    ``scores``: held out by feed, centre and radius of the mounting taken out: what the gates read.
    ``bundle``: the map as it would be served.
    """

    weights: Weights
    rows: tuple[Mapping[str, Any], ...]
    mounting_share: float
    scores: Scores
    bundle: Bundle


def learn_session(runs: Sequence[Run]) -> LearnedSession:
    """Learn runs 1 to 3 of every feed, and score the fourth.

    ``runs``: one mounting of the bar.
    """
    learned = [r for r in runs if r.meta.repeat < RUNS_OF_A_FEED]
    kept = [r for r in runs if r.meta.repeat == RUNS_OF_A_FEED]
    weights = _weights(learned)
    rows = tuple(_scored([r for r in kept if r.meta.feed_mm_min == f], f, weights) for f in FEEDS_MM_MIN)
    return LearnedSession(weights, rows, _mounting_share(weights), _by_feed(learned), map_bundle(weights))


def map_bundle(weights: Weights) -> Bundle:
    """Return a map of positions as a bundle: no delay, the box of the path angle.

    ``weights``: by direction.
    """
    builder = GraphBuilder()
    ccw, cw = (_sum_of_waves(builder, weights[d]) for d in DIRECTIONS)
    forward = builder.apply("step", builder.input("direction_sign"))
    graph = builder.graph({"radial_um": cw + forward * (ccw - cw)})
    return create_bundle(
        name=NAME,
        machine=MACHINE,
        model_version=0,
        inputs=[
            Input("path_angle_rad", "rad", "path", TICK_HZ, "path", -_FARTHEST_RAD, _FARTHEST_RAD),
            Input("direction_sign", "1", "path", TICK_HZ, "path", -1.0, 1.0),
        ],
        outputs=[Output("radial_um", "path_radial", "error")],
        tick_graph=graph,
        safety=SafetyLimits(clamp_um=_CLAMP_UM),
        provenance=Provenance(code_version=__version__),
    )


def register_map(home: Home, learned: LearnedSession, geometry: Mapping[str, Any]) -> RegisteredVersion:
    """Register the map as any trained candidate, so that the gates can say what they think.

    ``home``: registry.
    ``learned``: the map.
    ``geometry``: of the machine.
    """
    graph = learned.bundle.tick_graph
    candidate = Candidate(
        name=NAME,
        family="symbolic",
        promotable=True,
        complexity=len(graph.nodes),
        scores={"feed_mm_min": learned.scores},
        train_rms_um=learned.scores.rms_um,
        latency=bundle_latency(learned.bundle),
        equation=to_text(graph),
        bundle=learned.bundle.to_dict(),
    )
    before = rms([row["before_um"] for row in learned.rows])
    report = TrainingReport(
        machine=MACHINE,
        campaign="one session, as the thesis",
        table_versions={},
        noise_floor_um=float("nan"),
        rms_before_um=before,
        n_runs=learned.scores.n_runs,
        n_rows=0,
        candidates=(candidate,),
        proposed=NAME,
        seed=0,
    )
    registry = Registry(home)
    ids = registry.log_training(report, {})
    version = registry.register(report, ids[NAME], candidate, "A map of one session, as the thesis.")
    conditions = [(PLANE, RADIUS_MM, feed) for feed in FEEDS_MM_MIN]
    registry.attach(version, {"geometry.json": json.dumps(dict(geometry)), CONDITIONS_FILE: json.dumps(conditions)})
    return registry.version(MACHINE, version.version)


def without_mounting(runs: Sequence[Run], values: Sequence[Floats]) -> list[Floats]:
    """Return values with one centre and radius, common to the runs, taken out.

    ``runs``: circles of one mounting.
    ``values``: of each run, um.
    """
    basis = np.concatenate([position_waves(run)[:, :3] for run in runs])
    joined = np.concatenate(values)
    rest = joined - basis @ np.linalg.lstsq(basis, joined, rcond=None)[0]
    return np.split(rest, np.cumsum([len(v) for v in values])[:-1])


def _weights(runs: Sequence[Run]) -> dict[str, Floats]:
    return {d: fit_position_map([r for r in runs if r.meta.direction == d]) for d in DIRECTIONS}


def _reading(run: Run) -> Floats:
    return np.asarray(run.samples["deviation_um"])


def _after(run: Run, weights: Weights) -> Floats:
    return np.asarray(_reading(run) - position_waves(run) @ weights[str(run.meta.direction)])


def _scored(runs: Sequence[Run], feed: float, weights: Weights) -> dict[str, Any]:
    before = np.concatenate([_reading(r) for r in runs])
    after = np.concatenate([_after(r, weights) for r in runs])
    return {
        "feed_mm_min": feed,
        "runs": len(runs),
        "r2": 1.0 - float((after**2).sum() / ((before - before.mean()) ** 2).sum()),
        "before_um": rms(before),
        "after_um": rms(after),
    }


def _mounting_share(weights: Weights) -> float:
    """Return the share of radius and first harmonic, which are what a mounting looks like."""
    size = np.r_[1.0, np.full(2 * HARMONICS, 0.5)]
    power = np.sum([size * w**2 for w in weights.values()], axis=0)
    return float(power[:3].sum() / power.sum())


def _by_feed(runs: Sequence[Run]) -> Scores:
    """Leave one feed out at a time, as the gates ask, with the mounting taken out."""
    ratios, left, plain = {}, [], []
    for feed in FEEDS_MM_MIN:
        weights = _weights([r for r in runs if r.meta.feed_mm_min != feed])
        outside = [r for r in runs if r.meta.feed_mm_min == feed]
        before = np.concatenate(without_mounting(outside, [_reading(r) for r in outside]))
        after = np.concatenate(without_mounting(outside, [_after(r, weights) for r in outside]))
        ratios[f"F{feed:g}"] = rms(after) / rms(before)
        left.append(after)
        plain.append(before)
    rest, all_before = np.concatenate(left), np.concatenate(plain)
    worst = max(ratios, key=lambda key: ratios[key])
    return Scores(
        group="feed_mm_min",
        r2=1.0 - float((rest**2).sum() / (all_before**2).sum()),
        rms_um=rms(rest),
        mae_um=float(np.abs(rest).mean()),
        worst_slice_ratio=ratios[worst],
        worst_slice=worst,
        n_groups=len(FEEDS_MM_MIN),
        n_runs=len(runs),
    )


def _sum_of_waves(builder: GraphBuilder, weights: Floats) -> Expression:
    angle = builder.input("path_angle_rad")
    waves = [builder.apply(name, float(h) * angle) for h in range(1, HARMONICS + 1) for name in ("cos", "sin")]
    terms = [float(w) * wave for w, wave in zip(weights[1:], waves, strict=True)]
    return builder.total([builder.constant(float(weights[0])), *terms])
