"""A twin of tones as a correction: its bundle, judged by frequencies and amplitudes left out."""

from __future__ import annotations

import cmath
import math
from dataclasses import replace
from functools import partial

import numpy as np

from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.kinds.sinusoidal._candidates import Predicted, judged
from dtwin.kinds.sinusoidal._freeze import tone_of, tone_twin_bundle
from dtwin.kinds.sinusoidal._gates import correction_radius, dead_terms
from dtwin.kinds.sinusoidal._grid import ToneCondition
from dtwin.kinds.sinusoidal._groups import HELD_OUT, ToneGroups, load_tone_groups
from dtwin.lake.store import Lake
from dtwin.physics.gridding import Indices
from dtwin.physics.observations import Observations
from dtwin.physics.twin import Twin, frozen_residual_um, predict_um
from dtwin.serve.export import to_text
from dtwin.statistics import rms
from dtwin.train.latency import bundle_latency
from dtwin.train.results import Candidate
from dtwin.train.twin_terms import TwinBundle
from dtwin.twins.correct import LITTLE
from dtwin.twins.judged import NAME, Judged
from dtwin.twins.measured import pure_rms_um
from dtwin.twins.path_way import BY_SHAPE, MEAN_IS_TOLD, TwinWay
from dtwin.twins.seen import Seen

_FEWEST_FREQUENCIES, _FEWEST_AMPLITUDES = 3, 2


def freeze_tones(twin: Twin, obs: Observations, home: Home) -> TwinBundle:
    """Freeze a twin of tones, when there are enough of them to leave one out.

    ``obs``: the runs that it was fitted to.
    ``home``: where the campaign's signals are: the window is that of its accelerometer.
    """
    groups = _groups(twin, home)
    counts = [len(np.unique(groups.label(name))) for name in HELD_OUT]
    if counts[0] < _FEWEST_FREQUENCIES or counts[1] < _FEWEST_AMPLITUDES:
        raise InputError(
            "too few tones to judge a correction by what was left out",
            code="correct.tones",
            where=f"twin {twin.name}, campaign {twin.campaign}",
            got=f"{counts[0]} frequencies, {counts[1]} amplitudes",
            allowed=f"{_FEWEST_FREQUENCIES} frequencies and {_FEWEST_AMPLITUDES} amplitudes at least",
        )
    return tone_twin_bundle(twin, obs, groups)


def judge_tones(frozen: TwinBundle, seen: Seen, home: Home) -> Judged:
    """Fit the twin without one frequency, then without one amplitude at a time, and predict it.

    What is left out is left out of all tones of the twin. The unit of replication is the run, one tone each.
    """
    twin, obs = seen.twin, seen.obs
    groups = _groups(twin, home)

    def predict(train: ToneGroups, test: ToneGroups) -> Predicted:
        again = seen.refit(partial(_rows, kind=obs.grid.kind, without=_left_out(groups, train)))
        kept = tuple(t for t in again.terms if t.label in frozen.twin.labels)
        return _told(replace(again, terms=kept), obs, test)

    verdicts = judged(groups, predict)
    bundle = frozen.bundle
    graph = bundle.window_graph
    assert graph is not None
    radius, where = correction_radius(bundle, groups)
    left = frozen_residual_um(frozen.twin, obs)
    before = frozen_residual_um(replace(twin, terms=()), obs)
    equation = "tool / sent = 1 + the sum over the twin's effects; window.txt holds every number"
    candidate = Candidate(
        name=NAME,
        family="symbolic",
        promotable=True,
        complexity=len(graph.nodes),
        scores=verdicts.scores,
        train_rms_um=rms(left[obs.mask]),
        latency=bundle_latency(bundle),
        equation="\n".join([equation, *(f"  {t.label}: {t.instance.effect.formula}" for t in frozen.twin.terms)]),
        exports={"window.txt": to_text(graph), "tick.txt": to_text(bundle.tick_graph)},
        bundle=bundle.to_dict(),
        findings=(f"spectral radius of the corrected loop {radius:z.3f}, worst at {where}",) if where else (),
        numbers=verdicts.numbers | {"spectral_radius": radius, "dead_terms": float(len(dead_terms(bundle, groups)))},
    )
    tones = sorted(_tone(obs, row) for row in range(obs.n_rows))
    conditions = tuple((f"{f:g} Hz", f, a) for f, a in dict.fromkeys(tones))
    return Judged(candidate, pure_rms_um(obs, left), rms(before[obs.mask]), conditions)


def _groups(twin: Twin, home: Home) -> ToneGroups:
    lake = Lake(home.lake)
    return load_tone_groups(lake, lake.runs(twin.campaign))


def _tone(obs: Observations, row: int) -> tuple[float, float]:
    condition = obs.conditions[int(obs.condition_of[row])]
    assert isinstance(condition, ToneCondition)
    return condition.frequency_hz, condition.amplitude_um


def _left_out(groups: ToneGroups, train: ToneGroups) -> tuple[set[float], set[float]]:
    """Return the frequencies and the amplitudes that are not trained on."""
    frequency, amplitude = (set(groups.label(name)) - set(train.label(name)) for name in HELD_OUT)
    return frequency, amplitude


def _rows(obs: Observations, kind: str, without: tuple[set[float], set[float]]) -> Indices:
    """Return the rows of a test without frequencies and amplitudes; tests of another kind have none."""
    tones = [_tone(obs, row) if obs.grid.kind == kind else (math.nan, math.nan) for row in range(obs.n_rows)]
    return np.flatnonzero([f not in without[0] and a not in without[1] for f, a in tones])


def _told(twin: Twin, obs: Observations, groups: ToneGroups) -> Predicted:
    """Return amplitude error in um and lag in degrees of groups, as a twin foretells them."""
    predicted = predict_um(twin, obs)
    vectors = {_tone(obs, row): tone_of(predicted, obs, row) for row in range(obs.n_rows)}
    tones = zip(groups.frequency_hz.tolist(), groups.amplitude_um.tolist(), strict=True)
    responses = np.array([vectors[tone] for tone in tones])
    lags = np.degrees([-cmath.phase(v) for v in responses.tolist()])
    return (np.abs(responses) - 1.0) * groups.amplitude_um, lags


WAY = TwinWay(freeze_tones, judge_tones, BY_SHAPE, MEAN_IS_TOLD, LITTLE, {"type": "turning"})
