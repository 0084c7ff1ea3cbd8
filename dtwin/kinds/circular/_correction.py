"""A twin of circles as a correction: its bundle, judged by feeds and radii that were left out."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.kinds.circular.freeze import OUTPUT, twin_bundle
from dtwin.physics.gridding import Indices
from dtwin.physics.observations import Observations
from dtwin.physics.twin import Twin, frozen_residual_um
from dtwin.schema import Floats
from dtwin.serve.graph_code import to_c, to_latex, to_python, to_text
from dtwin.statistics import rms
from dtwin.train.latency import bundle_latency
from dtwin.train.results import Candidate, Scores
from dtwin.train.twin_terms import TwinBundle
from dtwin.twins.correct import NAME, Judged
from dtwin.twins.measured import pure_rms_um
from dtwin.twins.path_way import BY_LAW, TwinWay
from dtwin.twins.seen import Seen

_VISIBLE_SHARE = 0.1


def _freeze_circles(twin: Twin, obs: Observations, home: Home) -> TwinBundle:
    """Freeze a twin of circles; the geometry may state a delay of the correction."""
    delay = obs.campaign.machine_geometry.get("correction_delay_s", 0.0)
    return twin_bundle(twin, obs, horizon_s=float(delay))


def _judge_circles(frozen: TwinBundle, seen: Seen, home: Home) -> Judged:
    """Fit the twin without one feed, then without one radius at a time, and predict it.

    What is left out is left out of all circles of the twin.

    ``home``: not used: the runs say everything.
    """
    twin, obs = seen.twin, seen.obs
    left = frozen_residual_um(frozen.twin, obs)
    before = frozen_residual_um(replace(twin, terms=()), obs)
    bundle = frozen.bundle
    graph = bundle.tick_graph
    scores = {
        group: scored
        for group in ("feed_mm_min", "radius_mm")
        if (scored := _held_out(frozen, seen, group)) is not None
    }
    candidate = Candidate(
        name=NAME,
        family="symbolic",
        promotable=True,
        complexity=len(graph.nodes),
        scores=scores,
        train_rms_um=rms(left[obs.mask]),
        latency=bundle_latency(bundle),
        equation=to_text(graph),
        exports={
            "equation.txt": to_text(graph),
            "equation.tex": to_latex(graph),
            "equation.py": to_python(graph),
            "equation.c": to_c(graph, bundle.tick_inputs, (), (OUTPUT,)),
        },
        bundle=bundle.to_dict(),
    )
    conditions = {(c.plane, c.radius_mm, c.feed_mm_min) for c in obs.conditions}
    return Judged(candidate, pure_rms_um(obs, left), rms(before[obs.mask]), tuple(sorted(conditions)))


def _held_out(frozen: TwinBundle, seen: Seen, group: str) -> Scores | None:
    """Fit the twin without one value of the group at a time, and predict it."""
    obs = seen.obs
    label = _labels(obs, group)
    values = np.unique(label)
    rest, plain = np.zeros(obs.y_um.shape), np.zeros(obs.y_um.shape)
    for value in values:
        outside = np.flatnonzero(label == value)
        try:
            again = seen.refit(partial(_other_rows, kind=obs.grid.kind, group=group, value=float(value)))
        except InputError:
            return None
        kept = [t for t in again.terms if t.label in frozen.twin.labels]
        there = obs.take(outside)
        rest[outside] = frozen_residual_um(replace(again, terms=tuple(kept)), there)
        plain[outside] = frozen_residual_um(replace(again, terms=()), there)
    floor_um = pure_rms_um(obs, rest)
    ratios: dict[str, float] = {}
    for number, condition in enumerate(obs.conditions):
        rows = obs.condition_of == number
        mask = obs.mask[rows]
        # Where it changes less than repeats could show, it makes nothing worse or better.
        if rms((rest[rows] - plain[rows])[mask]) > _VISIBLE_SHARE * floor_um:
            ratios[str(condition)] = rms(rest[rows][mask]) / rms(plain[rows][mask])
    if not ratios:
        return None
    worst = max(ratios, key=lambda key: ratios[key])
    residual_um = rest[obs.mask]
    return Scores(
        group=group,
        r2=1.0 - float(np.mean(residual_um**2) / np.mean(plain[obs.mask] ** 2)),
        rms_um=rms(residual_um),
        mae_um=float(np.mean(np.abs(residual_um))),
        worst_slice_ratio=ratios[worst],
        worst_slice=worst,
        n_groups=len(values),
        n_runs=len(set(obs.run_of.tolist())),
    )


def _labels(obs: Observations, group: str) -> Floats:
    return np.array([float(getattr(m, group) or 0.0) for m in obs.runs])


def _other_rows(obs: Observations, kind: str, group: str, value: float) -> Indices:
    """Return the rows of a test without those that are left out; tests of another kind say nothing of a feed or a radius."""
    return np.flatnonzero(_labels(obs, group) != value) if obs.grid.kind == kind else np.arange(obs.n_rows)


WAY = TwinWay(_freeze_circles, _judge_circles, BY_LAW, ("nothing_missing",), 0.0)
