"""Candidates for the error of a tone, judged by frequencies and amplitudes that were left out, and one training of them."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from sklearn.exceptions import ConvergenceWarning

from dtwin.features.sine import fit_tone, lag_deg
from dtwin.features.tone_window import HORIZON_S
from dtwin.kinds.sinusoidal._bundle import Action, tone_bundle
from dtwin.kinds.sinusoidal._gates import MOST_RADIUS, correction_radius, dead_terms
from dtwin.kinds.sinusoidal._groups import (
    HELD_OUT,
    ToneGroups,
    exponent,
    feature_findings,
    heard_groups,
    load_tone_groups,
    noise_floor_um,
)
from dtwin.kinds.sinusoidal._laws import Law, power_law, printed_form, searched, two_modes
from dtwin.lake.store import Lake
from dtwin.progress import StageProgress, silent
from dtwin.schema import Floats
from dtwin.serve.graph_code import to_text
from dtwin.statistics import rms
from dtwin.train.comparison_models import RECIPES, Recipe, fitted
from dtwin.train.latency import bundle_latency
from dtwin.train.results import OUTPUT_RMS, Candidate, Scores, Training, TrainingReport
from dtwin.train.symbolic import Engine

# A net keeps a tenth apart to know when to stop.
_FEWEST_FOR_NET = 24
_EVERY = 4
_RIDGE = 1e-9
_EXPLODED_UM = 1e4
# Amplitude error in um and lag in degrees of groups, from a fit to others.
Predicted = tuple[Floats, Floats]
_Predict = Callable[[ToneGroups, ToneGroups], Predicted]
FORMS: dict[str, Callable[[ToneGroups], tuple[Law, Law]]] = {
    "two-modes": two_modes,
    "power-law": power_law,
    "printed-form": printed_form,
}


@dataclass(frozen=True)
class _Judged:
    """How well a way to predict does on what it did not see.

    ``scores``: of the amplitude error, by what was left out.
    ``numbers``: of the phase error: ``leave_..._out.phase_r2`` and ``phase_mae_deg``.
    """

    scores: dict[str, Scores]
    numbers: dict[str, float]


def judged(groups: ToneGroups, predict: _Predict) -> _Judged:
    """Leave out every frequency, then every amplitude, in turn.

    ``predict``: given groups to fit to and groups to predict, returns amplitude and phase errors.
    """
    scores: dict[str, Scores] = {}
    numbers: dict[str, float] = {OUTPUT_RMS: 0.0}
    for name in HELD_OUT:
        label = groups.label(name)
        amplitude, phase = np.zeros(groups.n), np.zeros(groups.n)
        for value in np.unique(label):
            out = label == value
            amplitude[out], phase[out] = predict(groups.only(~out), groups.only(out))
        scores[name] = _scores(groups, amplitude, name)
        rest = groups.phase_error_deg - phase
        numbers[f"leave_{name}_out.phase_r2"] = _r2(groups.phase_error_deg, phase)
        numbers[f"leave_{name}_out.phase_mae_deg"] = float(np.mean(np.abs(rest)))
        # Of the wave: half of the squared error vector.
        square = (groups.amplitude_error_um - amplitude) ** 2 + (np.radians(rest) * groups.amplitude_um) ** 2
        numbers[OUTPUT_RMS] = max(numbers[OUTPUT_RMS], float(np.sqrt(square.mean() / 2.0)))
    return _Judged(scores, numbers)


def _scores(groups: ToneGroups, amplitude: Floats, name: str) -> Scores:
    rest = groups.amplitude_error_um - amplitude
    ratio = np.abs(rest) / np.maximum(np.abs(groups.amplitude_error_um), 1e-9)
    worst = int(np.argmax(ratio))
    where = f"{groups.frequency_hz[worst]:g} Hz {groups.amplitude_um[worst]:g} µm"
    return Scores(
        name,
        _r2(groups.amplitude_error_um, amplitude),
        rms(rest),
        float(np.mean(np.abs(rest))),
        float(ratio[worst]),
        where,
        len(np.unique(groups.label(name))),
        groups.n,
    )


def _r2(true: Floats, predicted: Floats) -> float:
    return 1.0 - float(np.sum((true - predicted) ** 2) / np.sum((true - true.mean()) ** 2))


def _law_candidates(
    groups: ToneGroups, machine: str, engine: Engine | None, seed: int, table_versions: dict[str, int]
) -> list[Candidate]:
    """Return the candidates that are equations, each with its bundle.

    ``groups``: groups that the accelerometer hears.
    ``engine``: free search; Operon without.
    """
    given = [form_candidate(groups, machine, name, table_versions) for name in FORMS]
    return [*given, searched_candidate(groups, machine, engine, seed, table_versions)]


def form_candidate(
    groups: ToneGroups, machine: str, name: str, table_versions: dict[str, int], action: Action = "inverse"
) -> Candidate:
    """Return the candidate of one of ``FORMS``; parameters as for :func:`_law_candidates`."""
    fit = FORMS[name]

    def predict(train: ToneGroups, test: ToneGroups) -> Predicted:
        return _values(fit(train), test)

    scored = judged(groups, predict)
    return _law_candidate(groups, fit(groups), name, scored, machine, table_versions, action)


def searched_candidate(
    groups: ToneGroups,
    machine: str,
    engine: Engine | None,
    seed: int,
    table_versions: dict[str, int],
    action: Action = "inverse",
) -> Candidate:
    """Return the candidate of the free search; parameters as for :func:`_law_candidates`.

    Its scores are those of searches without what is predicted: form, features and constants.
    """
    amplitude, phase, front = searched(groups, engine, seed)

    def again(train: ToneGroups, test: ToneGroups) -> Predicted:
        return _values(searched(train, engine, seed)[:2], test)

    name = f"symbolic-{engine.name if engine else 'operon'}"
    made = _law_candidate(groups, (amplitude, phase), name, judged(groups, again), machine, table_versions, action)
    return replace(made, front=tuple({"nodes": p["nodes"], "rms_um": p["rms"]} for p in front))


def _values(laws: tuple[Law, Law], groups: ToneGroups) -> Predicted:
    return laws[0].values(groups.columns), laws[1].values(groups.columns)


def _law_candidate(
    groups: ToneGroups,
    laws: tuple[Law, Law],
    name: str,
    judged: _Judged,
    machine: str,
    table_versions: dict[str, int],
    action: Action,
) -> Candidate:
    bundle = tone_bundle(*laws, groups, name, machine, action, table_versions)
    radius, where = correction_radius(bundle, groups)
    dead = dead_terms(bundle, groups)
    assert bundle.window_graph is not None
    rest = groups.amplitude_error_um - laws[0].values(groups.columns)
    numbers = judged.numbers | {"spectral_radius": radius, "dead_terms": float(len(dead))}
    equation = f"amplitude error, µm = {laws[0].readable()}\nlag, deg = {laws[1].readable()}"
    findings = [f"{name_} is a dead constant on clean sines" for name_ in dead]
    if where:
        findings.append(f"spectral radius of the corrected loop {radius:z.3f}, worst at {where}")
    return Candidate(
        name=name,
        family="symbolic",
        promotable=True,
        complexity=len(bundle.window_graph.nodes),
        scores=judged.scores,
        train_rms_um=rms(rest),
        latency=bundle_latency(bundle),
        equation=equation,
        exports={"equation.txt": equation, "tick.txt": to_text(bundle.tick_graph)},
        bundle=bundle.to_dict(),
        findings=tuple(findings),
        numbers=numbers,
    )


def _compared_candidates(groups: ToneGroups, seed: int) -> list[Candidate]:
    """Return what equations are compared with: trivial ones, regressors on the features, NARX.

    ``groups``: groups that the accelerometer hears.
    """

    def mean(train: ToneGroups, test: ToneGroups) -> Predicted:
        one = np.ones(test.n)
        return one * train.amplitude_error_um.mean(), one * train.phase_error_deg.mean()

    ways: list[tuple[str, Any, int, _Predict]] = [
        ("zero", "baseline", 0, lambda train, test: (np.zeros(test.n), np.zeros(test.n))),
        ("constant", "baseline", 2, mean),
    ]
    enough = groups.n >= _FEWEST_FOR_NET
    usable = [r for r in RECIPES if r.columns == "all" and (enough or r.family != "neural")]
    ways += [(r.name, r.family, 0, _regressor(r, seed)) for r in usable]
    with warnings.catch_warnings():
        # A comparison model that has not converged is judged as it is.
        warnings.simplefilter("ignore", ConvergenceWarning)
        return [narx_candidate(groups), *(_compared(groups, *way) for way in ways)]


def narx_candidate(groups: ToneGroups) -> Candidate:
    """Return the baseline that predicts the tool's error from lagged commands."""
    return _compared(groups, "narx", "baseline", 2 * _Narx.LAGS + 1, _narx)


def _compared(groups: ToneGroups, name: str, family: Any, size: int, predict: _Predict) -> Candidate:
    scored = judged(groups, predict)
    rest = groups.amplitude_error_um - predict(groups, groups)[0]
    return Candidate(
        name,
        family,
        False,
        size,
        scored.scores,
        rms(rest),
        findings=("not an expression: cannot be promoted",) if family != "baseline" else (),
        numbers=scored.numbers,
    )


def _regressor(recipe: Recipe, seed: int) -> _Predict:
    def predict(train: ToneGroups, test: ToneGroups) -> Predicted:
        size = np.abs(train.features).max(axis=0)
        tone = np.unique(train.frequency_hz, return_inverse=True)[1]
        amplitude, phase = (
            fitted(recipe, seed, train.features, target, size, tone).predict(test.features)
            for target in (train.amplitude_error_um, train.phase_error_deg)
        )
        return amplitude, phase

    return predict


def _narx(train: ToneGroups, test: ToneGroups) -> Predicted:
    model = _Narx.fitted(train)
    errors = [model.errors(trace, f) for trace, f in zip(test.traces, test.frequency_hz, strict=True)]
    values: NDArray[np.float64] = np.array(errors)
    return values[:, 0], values[:, 1]


def _proposed(candidates: Sequence[Candidate], most_radius: float) -> str:
    """Return the equation with the smallest held-out error among those without dead terms.

    ``most_radius``: spectral radius beyond which an equation is proposed only when there is no other.
    """
    laws = [c for c in candidates if c.promotable]
    sound = [c for c in laws if c.numbers["dead_terms"] == 0.0 and c.numbers["spectral_radius"] <= most_radius]
    return min(sound or laws, key=lambda c: c.held_out.rms_um).name


@dataclass(frozen=True)
class _Narx:
    """Linear in its lags, which is what a linear slide asks for.

    ``own``, ``command``: weights of earlier errors, and of the command now and earlier.
    ``rate_hz``: samples a second of the model.
    """

    LAGS: ClassVar[int] = 6
    own: Floats
    command: Floats
    rate_hz: float

    @classmethod
    def fitted(cls, groups: ToneGroups) -> _Narx:
        """Fit one step ahead on every sample of the groups, by ridge regression."""
        n = cls.LAGS
        size = 2 * n + 1
        gram, moment = np.zeros((size, size)), np.zeros(size)
        for trace in groups.traces:
            command, error = trace[0, ::_EVERY], (trace[1] - trace[0])[::_EVERY]
            lagged = [error[n - k : -k] for k in range(1, n + 1)]
            driven = [command[n - k : len(command) - k] for k in range(n + 1)]
            design = np.column_stack([*lagged, *driven])
            gram += design.T @ design
            moment += design.T @ error[n:]
        weights = np.linalg.solve(gram + _RIDGE * np.trace(gram) * np.eye(size), moment)
        return cls(weights[:n], weights[n:], groups.contract.rate_hz / _EVERY)

    def errors(self, trace: Floats, frequency_hz: float) -> tuple[float, float]:
        """Return amplitude error in um and lag in degrees of the last second, from the command alone.

        ``trace``, (2, n): command and tool; only the command is used.
        """
        # As everywhere: importing it takes half a second, which most commands can do without.
        from scipy.signal import lfilter

        command = trace[0, ::_EVERY]
        error = lfilter(self.command, np.concatenate([[1.0], -self.own]), command)
        tool = command + np.clip(np.nan_to_num(error), -_EXPLODED_UM, _EXPLODED_UM)
        t = np.arange(len(command)) / self.rate_hz
        last = t >= t[-1] - HORIZON_S
        sent, followed = (fit_tone(t[last], v[last], frequency_hz) for v in (command, tool))
        return followed.amplitude - sent.amplitude, lag_deg(sent, followed)


def train_tones(
    lake: Lake, name: str, *, seed: int = 1, engine: Engine | None = None, progress: StageProgress = silent
) -> Training:
    """Train every candidate on a campaign of tones.

    Groups with a data-quality error, and groups that the accelerometer does not hear, are left out.

    ``engine``: free symbolic search; Operon by default.
    """
    campaign, versions = lake.campaign(name), dict(lake.versions())
    everything = load_tone_groups(lake, lake.runs(name))
    groups = heard_groups(everything)
    progress("features of the first 5 s", 1, 1, f"{groups.n} of {everything.n} groups")
    laws = _law_candidates(groups, campaign.machine, engine, seed, versions)
    progress("equations", 1, 1, "")
    others = _compared_candidates(groups, seed)
    progress("comparison models", 1, 1, "")
    candidates = sorted([*laws, *others], key=lambda c: c.held_out.rms_um)
    (floor, freedom), told = noise_floor_um(groups), what_was_seen(everything)
    if not np.isnan(floor):
        told.append(
            "the accelerometer hears part of what makes repeats differ: an equation may leave less than "
            "they disagree by"
        )
    report = TrainingReport(
        machine=campaign.machine,
        campaign=name,
        table_versions=versions,
        noise_floor_um=floor,
        noise_floor_dof=freedom,
        rms_before_um=rms(groups.amplitude_error_um),
        n_runs=groups.n,
        n_rows=groups.n,
        candidates=tuple(candidates),
        proposed=_proposed(candidates, MOST_RADIUS),
        seed=seed,
        told=tuple(told),
    )
    conditions = [(f"{f:g} Hz", float(f), float(a)) for f, a in _grid(groups)]
    return Training(report, campaign.machine_geometry, tuple(conditions))


def what_was_seen(everything: ToneGroups) -> list[str]:
    """Say what the groups show before any equation: what is heard, constants, exponents."""
    groups = heard_groups(everything)
    acceleration = groups.feature("rms")
    deaf = everything.n - groups.n
    return [
        f"{deaf} of {everything.n} groups are below the accelerometer's noise and left out; the "
        "validity box refuses to correct there",
        *feature_findings(groups),
        f"amplitude error grows with acceleration to the power "
        f"{exponent(acceleration, groups.amplitude_error_um):z.3f}, the error beyond the encoder to "
        f"the power {exponent(acceleration, groups.beyond_encoder_um):z.3f}; 1 is inertia on a spring",
        "an LSTM was not tried: the package has no deep-learning library",
    ]


def _grid(groups: ToneGroups) -> list[tuple[Any, Any]]:
    return sorted(set(zip(groups.frequency_hz.tolist(), groups.amplitude_um.tolist(), strict=True)))
