"""A twin of an axis as a correction: its bundle, judged by runs that were left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.kinds.linear._freeze import flanks_twin_bundle, pitch_mm, reach_mm
from dtwin.kinds.linear._gates import screw_metrics
from dtwin.kinds.linear._judging import (
    HELD_OUT,
    explained_share,
    noise_floor_um,
    runs_left_out,
    scores_of,
    stacked,
    table_rms_um,
)
from dtwin.physics.gridding import Indices
from dtwin.physics.observations import Observations
from dtwin.physics.twin import Twin, frozen_residual_um, predict_um
from dtwin.positioning.matrix import LinearTest
from dtwin.schema import Floats
from dtwin.serve.export import to_text
from dtwin.statistics import rms
from dtwin.train.latency import bundle_latency
from dtwin.train.results import Candidate
from dtwin.train.twin_terms import TwinBundle
from dtwin.twins.correct import LITTLE
from dtwin.twins.judged import NAME, Judged
from dtwin.twins.path_way import BY_SHAPE, MEAN_IS_TOLD, TwinWay
from dtwin.twins.seen import Seen

_FEWEST_RUNS = 2


def freeze_axis(twin: Twin, obs: Observations, home: Home) -> TwinBundle:
    """Freeze a twin of an axis, when there are runs enough to judge it by."""
    test_of_runs(obs)
    return flanks_twin_bundle(twin, obs)


def judge_axis(frozen: TwinBundle, seen: Seen, home: Home) -> Judged:
    """Fit the twin without one run of this axis at a time, and predict it.

    The unit of replication is the run, one sweep up and one down. The zero of the laser is taken from
    the runs that were not left out, as it is for tables.

    ``home``: not used: the runs say everything.
    """
    obs = seen.obs
    test = test_of_runs(obs)
    left = runs_left_out(test, lambda run: _foretold_um(frozen, seen, run))
    error = stacked(test)[2]
    floor = noise_floor_um(test)
    reach = reach_mm(obs)
    rest = frozen_residual_um(frozen.twin, obs)
    bundle = frozen.bundle
    candidate = Candidate(
        name=NAME,
        family="symbolic",
        promotable=True,
        complexity=len(bundle.tick_graph.nodes),
        scores={HELD_OUT: scores_of(test, left)},
        train_rms_um=rms(rest[obs.mask]),
        latency=bundle_latency(bundle),
        equation=_equation(frozen.twin),
        exports={"tick.txt": to_text(bundle.tick_graph)},
        bundle=bundle.to_dict(),
        numbers={
            **screw_metrics(pitch_mm(obs), reach),
            "explained_share": explained_share(error, left, floor),
            "table_rms_um": table_rms_um(test),
        },
    )
    return Judged(candidate, floor, rms(error), ((obs.axes[0], *reach),))


def test_of_runs(obs: Observations) -> LinearTest:
    """Return the readings of a campaign in matrices, targets that some run missed left out."""
    both = [_rows(obs, run) for run in np.unique(obs.run_of).tolist()]
    ways = [obs.sense[rows].tolist() for rows in both]
    if len(both) < _FEWEST_RUNS or any(sorted(way) != [-1.0, 1.0] for way in ways):
        raise InputError(
            "a correction of a position cannot be judged",
            code="correct.runs",
            where=obs.campaign.name,
            got=f"{len(both)} runs, {ways.count([1.0, -1.0])} of them up and down",
            allowed=f"{_FEWEST_RUNS} runs or more, each up and down: one is left out in turn",
            hint="repeat the test: runs = 2 in the plan",
        )
    everywhere = obs.mask.all(axis=0)
    errors = {
        sense: np.column_stack([obs.y_um[r[obs.sense[r] == sense][0]][everywhere] for r in both])
        for sense in (1.0, -1.0)
    }
    return LinearTest(
        obs.grid.points[everywhere],
        errors[1.0],
        errors[-1.0],
        int(np.count_nonzero(~everywhere)),
        pitch_mm(obs),
        obs.axes[0],
    )


test_of_runs.__test__ = False  # type: ignore[attr-defined]


def _rows(obs: Observations, run: int) -> Indices:
    return np.flatnonzero(obs.run_of == run)


def _foretold_um(frozen: TwinBundle, seen: Seen, run: int) -> Floats:
    """Return what the other runs let expect of a run, in the order of ``stacked``."""
    obs = seen.obs
    number = np.unique(obs.run_of)[run]

    def other_rows(test: Observations) -> Indices:
        mine = test.campaign.name == obs.campaign.name
        return np.flatnonzero(test.run_of != number) if mine else np.arange(test.n_rows)

    others, own = obs.take(other_rows(obs)), _rows(obs, number)
    again = seen.refit(other_rows)
    kept = replace(again, terms=tuple(t for t in again.terms if t.label in frozen.twin.labels))
    zero_um = float((others.y_um - predict_um(kept, others))[others.mask].mean())
    here = obs.take(own[np.argsort(-obs.sense[own])])
    everywhere = obs.mask.all(axis=0)
    return np.asarray(predict_um(kept, here)[:, everywhere].ravel() + zero_um)


def _equation(twin: Twin) -> str:
    lines = [f"  {t.label}: {t.instance.effect.formula}" for t in twin.terms]
    return "\n".join(
        [
            "slide = min(max(slide before, position + forward flank), position + reverse flank)",
            "error = slide - position",
            "each flank = the sum over the twin's effects, in its direction,",
            "taken where the correction puts the screw; tick.txt holds every number",
            *lines,
        ]
    )


WAY = TwinWay(freeze_axis, judge_axis, BY_SHAPE, MEAN_IS_TOLD, LITTLE, {"type": "lathe"})
