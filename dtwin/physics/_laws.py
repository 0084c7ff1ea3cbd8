"""Whether the amplitude of an effect follows its law over feed, radius, direction and time."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dtwin.physics._rivals import Found
from dtwin.physics._score import NoiseLevel, Score, score_test
from dtwin.physics.candidates import Candidate, Candidates
from dtwin.physics.effect import Law
from dtwin.physics.observations import SETUP_COLUMNS, Observations
from dtwin.physics.problem import Problem, least_visible
from dtwin.physics.whitening import to_harmonics, within_condition
from dtwin.schema import Floats

_MATERIAL = 0.35
_CONFIRMED = 0.3
_ALPHA = 0.002
_ALPHA_MEASURED_WELL = 0.005
_CERTAIN = 0.05
# Time constants of a body that follows a logged channel, as shares of the campaign's length.
_SLOW = (0.1, 0.3, 1.0)


@dataclass(frozen=True)
class LawTest:
    """Result for one variable.

    ``variable``: what the amplitude was compared over; "time": what changed between repeats, logged channels among it;
    "delay": whether it follows its channel at once; "set-up": whether it is the same in every mounting.
    ``p_value``: of the hypothesis that the law holds.
    ``shift``: change of the exponent that fits best; for the direction, half the relative difference; for time, the
    relative change over the range of what changed; for delay, the share that comes late.
    ``uncertainty``: standard uncertainty of the shift.
    """

    variable: str
    p_value: float
    shift: float
    uncertainty: float

    @property
    def broken(self) -> bool:
        """Whether the law is rejected by a material amount."""
        alpha = _ALPHA_MEASURED_WELL if self.uncertainty < _CONFIRMED else _ALPHA
        return self.p_value < alpha and abs(self.shift) > _MATERIAL

    @property
    def confirmed(self) -> bool:
        """Whether the law holds and another one was ruled out."""
        return not self.broken and self.uncertainty < _CONFIRMED

    def as_dict(self) -> dict[str, float | str | bool]:
        """Return a JSON-ready mapping."""
        return {
            "variable": self.variable,
            "p_value": self.p_value,
            "shift": self.shift,
            "uncertainty": self.uncertainty,
            "broken": self.broken,
        }


def law_tests(problem: Problem, candidates: Candidates, candidate: Candidate, level: NoiseLevel) -> list[LawTest]:
    """Test the law of a candidate over every variable that the campaign changed."""
    term = candidate.term
    law = term.instance.effect.law
    columns = candidates.whitened(problem, term)
    with_it = problem.extended(candidate.visible, columns)
    amplitude = _amplitude(problem, columns)
    along = (columns @ amplitude).reshape(-1, problem.obs.n_bins)
    within = term.instance.effect.within_condition
    least = least_visible(term)
    out: list[LawTest] = []
    missed = with_it
    for variable, contrast in _contrasts(problem).items():
        if variable == "feed" and law.feed is None:
            continue
        if variable == "radius" and law.radius is None:
            continue
        if variable == "direction" and law.direction == "mixed":
            continue
        # The effect as fitted, scaled by the contrast: one column, whatever the effect has.
        profile = along * contrast[:, None]
        tests = _tested(with_it, variable, profile, level, within, least)
        out += tests
        if any(test.p_value < _CERTAIN for test in tests):
            missed = _with(missed, profile)
    if any(name.startswith(SETUP_COLUMNS) for name in term.instance.effect.needs):
        # What hangs on the mounting must be the same in every mounting.
        mounted = [
            test
            for contrast in _mountings(problem.obs)
            for test in _tested(with_it, "set-up", along * contrast[:, None], level, within, least)
        ]
        out += [_best_of(mounted)] if mounted else []
    if not within:
        # What a law misses by a little over radius or feed is not time, though runs have an order.
        changing = [
            test
            for contrast in _during(problem.obs, law)
            for test in _tested(missed, "time", along * contrast[:, None], level, True, least)
        ]
        out += [_best_of(changing)] if changing else []
    if within and term.instance.effect.needs:
        late = [
            test
            for lagging in _late(problem.obs)
            for test in _tested(
                with_it, "delay", _of(lagging, problem, candidate, amplitude) - along, level, True, least
            )
        ]
        out += [_best_of(late)] if late else []
    return out


def share_that_follows(effect: Found, rows: Floats) -> tuple[float, float]:
    """Return the share of an effect whose amplitude follows something else, and its uncertainty.

    ``effect``: the effect, with the campaign without it.
    ``rows``, (rows,): how large that other thing is in every row, with the sign of the direction.
    By the noise of the repeats; infinite when these runs cannot tell the two.
    """
    problem, term = effect.problem, effect.top.term
    columns = effect.candidates.whitened(problem, term)
    along = (columns @ _amplitude(problem, columns)).reshape(-1, problem.obs.n_bins)
    size = np.sqrt((along**2).sum(axis=1))
    other = along * np.divide(rows, size, out=np.zeros_like(size), where=size > 0.0)[:, None]
    other *= np.sqrt((along**2).sum() / max(float((other**2).sum()), 1e-300))
    with_it = problem.extended(effect.top.visible, columns)
    level = replace(effect.level, misfit=None)
    within = term.instance.effect.within_condition
    tests = _tested(with_it, "other", other, level, within, least_visible(term))
    return (abs(tests[0].shift), tests[0].uncertainty) if tests else (np.inf, np.inf)


def _with(problem: Problem, profile: Floats) -> Problem:
    """Return the problem with one more column known."""
    column = profile.reshape(-1, 1)
    return problem.extended(problem.visible(column)[0], column)


def _tested(
    with_it: Problem, variable: str, profile: Floats, level: NoiseLevel, within: bool, least: float
) -> list[LawTest]:
    column = profile.reshape(-1, 1)
    visible, share = with_it.visible(column, least=least)
    if not visible.shape[1]:
        return []
    score: Score = score_test(with_it, visible, with_it.residual, level, within=within)
    size = float(np.sqrt((column**2).sum() * share[0]))
    sign = float(np.sign(visible[:, 0] @ column[:, 0]))
    shift = sign * float(visible[:, 0] @ with_it.residual.ravel()) / size
    return [LawTest(variable, score.p_value, shift, float(np.sqrt(score.expected)) / size)]


def _best_of(tests: list[LawTest]) -> LawTest:
    """Return the test with the smallest p-value, which counts for all that were tried."""
    best = min(tests, key=lambda test: test.p_value)
    return replace(best, p_value=min(1.0, len(tests) * best.p_value))


def _late(obs: Observations) -> list[Observations]:
    """Return the runs with every logged channel as a slow body would follow it."""
    time_h = np.array([float(np.mean(c["time_h"])) for c in obs.columns])
    order = np.argsort(time_h, kind="stable")
    length_h = float(np.ptp(time_h))
    out = []
    # Runs that all bear one time say nothing of what came late.
    for share in _SLOW if length_h > 0.0 else ():
        constant_h = share * length_h
        columns = [dict(c) for c in obs.columns]
        for name in (n for n in obs.logged if n != "time_h"):
            value = [float(np.mean(obs.columns[row][name])) for row in order]
            slow = value[0]
            for number, row in enumerate(order):
                if number:
                    passed_h = time_h[row] - time_h[order[number - 1]]
                    mean = 0.5 * (value[number] + value[number - 1])
                    slow += (mean - slow) * -np.expm1(-passed_h / constant_h)
                columns[row][name] = slow
        out.append(replace(obs, columns=tuple(columns)))
    return out


def _of(lagging: Observations, problem: Problem, candidate: Candidate, amplitude: Floats) -> Floats:
    """Return what the candidate would be with late channels, whitened, shape (rows, n)."""
    term = candidate.term
    columns = to_harmonics(lagging.regressors(term.instance, term.shape))
    return np.asarray(problem.weighted(columns, np.arange(len(columns))) @ amplitude)


def _amplitude(problem: Problem, columns: Floats) -> Floats:
    """Return the amplitudes that fit best, shape (k,)."""
    left = columns - problem.basis @ (problem.basis.T @ columns)
    return np.asarray(np.linalg.lstsq(left, problem.residual.ravel(), rcond=1e-8)[0])


def _contrasts(problem: Problem) -> dict[str, Floats]:
    obs = problem.obs
    feed = np.log(obs.feed_mm_s)
    radius = np.log(obs.radius_mm)
    direction = obs.sense
    contrasts = {"feed": feed, "radius": radius, "direction": direction}
    return {name: values - values.mean() for name, values in contrasts.items() if np.ptp(values) > 0.05}


def _mountings(obs: Observations) -> list[Floats]:
    """Return, for each set-up beside the first one, what tells it from the others."""
    inside = [(obs.setup_of == number).astype(float) for number in range(1, len(obs.setups))]
    return [values - values.mean() for values in inside]


def _during(obs: Observations, law: Law) -> list[Floats]:
    """Return what an effect that should stay may follow: time, channels, and these belatedly.

    Where the law leaves open how the amplitude depends on the condition, only what changes
    between repeats: conditions that came in an order would otherwise look like time.
    """
    names = [n for n in obs.logged if not n.startswith(SETUP_COLUMNS)]
    series = [np.array([float(np.mean(c[n])) for c in obs.columns]) for n in names]
    slow = [n for n in names if n != "time_h"]
    series += [np.array([float(np.mean(c[n])) for c in late.columns]) for late in _late(obs) for n in slow]
    free = law.feed is None or law.radius is None
    out = []
    for values in series:
        whole = float(np.ptp(values))
        inside = within_condition(values[:, None], obs.condition_of)[0][:, 0]
        if whole > 0.0 and np.ptp(inside) > 1e-6 * whole:
            out.append((inside if free else values - values.mean()) / whole)
    return out
