"""A twin of tones as a correction: its bundle, a response over frequency and amplitude, judged by frequencies and amplitudes left out."""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.kinds.sinusoidal._bundle import AMPLITUDE, MOST_CREST, OUTPUT, PHASE, ROOM, command_inputs, two_rate_bundle
from dtwin.kinds.sinusoidal._candidates import Predicted, judged
from dtwin.kinds.sinusoidal._gates import MOST_ERROR_UM, correction_radius, dead_terms
from dtwin.kinds.sinusoidal._grid import ToneCondition
from dtwin.kinds.sinusoidal._groups import HELD_OUT, SENT_CREST, SENT_FREQUENCY, SENT_RMS, ToneGroups, load_tone_groups
from dtwin.lake.store import Lake
from dtwin.physics.gridding import Indices
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Term
from dtwin.physics.state import State
from dtwin.physics.twin import Twin, frozen_residual_um, predict_um
from dtwin.schema import Floats
from dtwin.serve.band import Band
from dtwin.serve.builder import Expression, GraphBuilder
from dtwin.serve.graph import Graph
from dtwin.serve.graph_code import to_text
from dtwin.serve.interface import Input
from dtwin.statistics import rms
from dtwin.train.latency import bundle_latency
from dtwin.train.results import Candidate
from dtwin.train.traced import NotTold, NotTraceable, Traced
from dtwin.train.twin_band import band, half_width, parameter_factor
from dtwin.train.twin_terms import TwinBundle, carried, traced_columns, weighted
from dtwin.twins.correct import LITTLE, NAME, Judged
from dtwin.twins.measured import pure_rms_um
from dtwin.twins.path_way import BY_SHAPE, MEAN_IS_TOLD, TwinWay
from dtwin.twins.seen import Seen
from dtwin.units import UM_PER_MM, shown_number

_FEWEST_FREQUENCIES, _FEWEST_AMPLITUDES = 3, 2


def _freeze_tones(twin: Twin, obs: Observations, home: Home) -> TwinBundle:
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
    return _tone_twin_bundle(twin, obs, groups)


def _judge_tones(frozen: TwinBundle, seen: Seen, home: Home) -> Judged:
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
    vectors = {_tone(obs, row): _tone_of(predicted, obs, row) for row in range(obs.n_rows)}
    tones = zip(groups.frequency_hz.tolist(), groups.amplitude_um.tolist(), strict=True)
    responses = np.array([vectors[tone] for tone in tones])
    lags = np.degrees([-cmath.phase(v) for v in responses.tolist()])
    return (np.abs(responses) - 1.0) * groups.amplitude_um, lags


WAY = TwinWay(_freeze_tones, _judge_tones, BY_SHAPE, MEAN_IS_TOLD, LITTLE, {"type": "turning"})


# Share of an effect's power beside the fundamental that a sine may leave.
_NOT_A_SINE = 1e-6
_BETWEEN = 20
_MARGIN = 1e-6
_LEAST_GAIN = 1e-3


def _tone_twin_bundle(twin: Twin, obs: Observations, groups: ToneGroups) -> TwinBundle:
    """Freeze the effects of a twin of tones that a sine can answer.

    The window tells frequency and amplitude of the sent command. From these the twin's own formulas tell
    gain and lag, and the command is divided by them.

    ``obs``: the runs that it was fitted to.
    ``groups``: of the same campaign: its window, and the validity box.
    """
    if obs.axes != ("Z",):
        raise InputError(
            "a correction of tones cannot be made of these runs",
            code="correct.axis",
            where=f"twin {twin.name}",
            got=f"axis {', '.join(obs.axes)}",
            allowed="axis Z, the only one whose equation can be written so far",
        )
    builder, inputs = GraphBuilder(), _inputs(groups)
    frequency, rms = (_held(builder, inputs, name) for name in (SENT_FREQUENCY, SENT_RMS))
    tone = _Tone(builder, twin, obs, frequency, rms * float(np.sqrt(2.0)))
    kept = carried(twin, tone.response)
    graph = _window_graph(tone, [*kept.traced])
    _require_smooth(graph, twin.name, groups)
    reach = float(np.abs(predict_um(kept.twin, obs)).max())
    versions = {k: v for k, v in twin.data.items() if isinstance(v, int)}
    factor = parameter_factor(twin, kept.twin, obs)
    bundle = two_rate_bundle(
        graph,
        inputs,
        groups,
        reach,
        f"twin-{twin.name}",
        twin.machine,
        table_versions=versions,
        band=None if factor is None else tone.band(kept.twin, factor),
    )
    return TwinBundle(bundle, kept.choices, kept.twin)


def _response_at(graph: Graph, frequency_hz: float, amplitude_um: float) -> complex:
    """Return tool over sent command as a vector, as a window graph tells it. ``graph``: of :func:`tone_twin_bundle`."""
    rms = amplitude_um / float(np.sqrt(2.0))
    told, _ = graph.evaluate({SENT_FREQUENCY: frequency_hz, SENT_RMS: rms}, {})
    return complex(told["gain_1"] * np.exp(-1j * told["phase_error_rad"]))


@dataclass(frozen=True)
class _Tone:
    """A twin's effects at a traced frequency (Hz) and amplitude (um)."""

    builder: GraphBuilder
    twin: Twin
    obs: Observations
    frequency: Expression
    amplitude: Expression

    def response(self, term: Term) -> tuple[Expression, Expression]:
        """Return what an effect does in step with the sine, and with the cosine, in um."""
        if (share := _beside_the_sine(term, self.twin, self.obs)) > _NOT_A_SINE:
            raise NotTraceable(
                f"{shown_number(100 * share, 2)} % of its power is not in the tone itself: a sine cannot carry its corners"
            )
        weights = self.twin.values(term)
        in_step = [
            weighted(term, self._state(sine, cosine), self.builder, weights)
            for sine, cosine in ((1.0, 0.0), (0.0, 1.0))
        ]
        return in_step[0], in_step[1]

    def band(self, kept: Twin, factor: Floats) -> Band:
        """Return how uncertain the correction is, tick by tick.

        The correction is the command times 1 / G - 1, G being tool over sent command: a change g of G changes it by
        -g / G^2, and what is in step with the sine and with the cosine of that acts at the command's phase.

        ``factor``: from ``parameter_factor``.
        """
        builder = self.builder
        lag, gain = builder.input("phase_error_rad"), builder.input("gain_1")
        angle = builder.input(PHASE) + lag * 2.0
        waves = builder.apply("sin", angle), builder.apply("cos", angle)
        in_step = [
            [c for term in kept.terms for c in traced_columns(term, self._state(sine, cosine), builder)]
            for sine, cosine in ((1.0, 0.0), (0.0, 1.0))
        ]
        acting = [sine * waves[0] + cosine * waves[1] for sine, cosine in zip(*in_step, strict=True)]
        # Before the first window it is zero.
        square = builder.apply("max", builder.apply("square", gain), _LEAST_GAIN**2)
        share = abs(builder.input(AMPLITUDE)) / self.amplitude / square
        return band(builder, OUTPUT, half_width(builder, acting, factor) * share)

    def _state(self, sine: float, cosine: float) -> Any:
        """Return the state where the command's phase has that sine and cosine."""
        condition = self.obs.conditions[0]
        real: State = self.obs.grid.state(
            self.obs.runs[0], condition, condition.feed_mm_min / 60.0, self.obs.campaign.machine_geometry
        )
        (axis,) = real.axes
        size_mm: Any = Traced([self.amplitude * (1.0 / UM_PER_MM)])
        rate_rad_s: Any = Traced([self.frequency * (2.0 * np.pi)])
        feed_mm_s = rate_rad_s * size_mm
        reversal: Any = NotTold("the time since a reversal")
        return replace(
            real,
            position_mm={axis: size_mm * sine},
            velocity_mm_s={axis: feed_mm_s * cosine},
            acceleration_mm_s2={axis: -rate_rad_s * feed_mm_s * sine},
            sensitivity={axis: np.ones(1)},
            since_reversal_s={axis: reversal},
            last_end={axis: reversal},
            angle_rad=np.array([np.arctan2(sine, cosine)]),
            radius_mm=size_mm,
            feed_mm_s=feed_mm_s,
        )


def _beside_the_sine(term: Term, twin: Twin, obs: Observations) -> float:
    """Return the largest share of an effect's power that is not in the fundamental."""
    done = obs.regressors(term.instance, term.shape) @ twin.values(term)
    phase = np.radians(obs.grid.points)
    basis = np.stack([np.sin(phase), np.cos(phase)]) * np.sqrt(2.0 / len(phase))
    rest = done - (done @ basis.T) @ basis
    total = np.maximum((done**2).sum(axis=1), 1e-300)
    return float(((rest**2).sum(axis=1) / total).max())


def _tone_of(predicted_um: Floats, obs: Observations, row: int) -> complex:
    """Return tool over command as a vector, from an error over the phase of the command.

    ``predicted_um``, (rows, n): tool minus command.
    """
    phase = np.radians(obs.grid.points)
    condition = obs.conditions[int(obs.condition_of[row])]
    assert isinstance(condition, ToneCondition)
    error = predicted_um[row] * (2.0 / len(phase)) / condition.amplitude_um
    return complex(1.0 + error @ np.sin(phase), error @ np.cos(phase))


def _window_graph(tone: _Tone, effects: list[tuple[Expression, Expression]]) -> Graph:
    builder, size = tone.builder, tone.amplitude
    real = 1.0 + builder.total([sine for sine, _ in effects]) / size
    imaginary = builder.total([cosine for _, cosine in effects]) / size
    gain = builder.apply("sqrt", builder.apply("square", real) + builder.apply("square", imaginary))
    return builder.graph(
        {
            "amplitude_error_um": (gain - 1.0) * size,
            "phase_error_rad": -builder.apply("atan2", imaginary, real),
            "gain_1": gain,
        }
    )


def _held(builder: GraphBuilder, inputs: Sequence[Input], name: str) -> Expression:
    """Return a feature held at the edge of its box: the guard refuses what is outside of it."""
    box = next(i for i in inputs if i.name == name)
    return builder.apply("min", builder.apply("max", builder.input(name), box.low), box.high)


def _inputs(groups: ToneGroups) -> list[Input]:
    rate = groups.contract.rate_hz / groups.contract.hop
    # A window tells a frequency to half the distance of its lines.
    half_line = 0.5 * groups.contract.rate_hz / groups.contract.n_samples
    low, high = float(groups.frequency_hz.min()), float(groups.frequency_hz.max())
    largest = float(groups.amplitude_um.max())
    # A sent tone is larger than the commanded one where the slide falls short.
    highest = {AMPLITUDE: largest * (1.0 + _MARGIN), SENT_RMS: ROOM * largest / float(np.sqrt(2.0))}
    return [
        *(replace(i, high=highest.get(i.name, i.high)) for i in command_inputs(groups)),
        Input(SENT_FREQUENCY, "hz", "path", rate, "feature", max(low - half_line, 0.5 * low), high + half_line),
        # In no equation: it tells a tone from anything else that may be commanded.
        Input(SENT_CREST, "1", "path", rate, "feature", 1.0, MOST_CREST),
    ]


def _require_smooth(graph: Graph, name: str, groups: ToneGroups) -> None:
    """Refuse a response that swings out between two neighbouring tones beyond what both show."""
    for amplitude in np.unique(groups.amplitude_um).tolist():
        tones = np.unique(groups.frequency_hz[groups.amplitude_um == amplitude])
        for low, high in zip(tones[:-1].tolist(), tones[1:].tolist(), strict=True):
            between = np.linspace(low, high, _BETWEEN + 1)
            told = np.array([_response_at(graph, float(f), amplitude) for f in between])
            for part in (told.real, told.imag):
                ends = sorted((part[0], part[-1]))
                out = max(ends[0] - part.min(), part.max() - ends[1]) * amplitude
                if out > MOST_ERROR_UM:
                    raise InputError(
                        "the twin's response swings between tones that were measured",
                        code="correct.between",
                        where=f"twin {name}, {low:g} to {high:g} Hz",
                        got=f"{out:z.2f} µm at {amplitude:g} µm beyond what both tones show",
                        allowed=f"{MOST_ERROR_UM:g} µm: what lies between tones must be seen by them",
                        hint="measure tones closer together there",
                    )
