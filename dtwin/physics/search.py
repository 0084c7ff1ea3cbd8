"""Find effects one by one until what is left is not significant."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from dtwin.physics.candidates import Candidate, Candidates, independent, probes
from dtwin.physics.cross_validation import left_out_gain
from dtwin.physics.localise import in_angle, systematic_rms_um
from dtwin.physics.problem import Problem
from dtwin.physics.score import NoiseLevel, lack_of_fit, noise_level, score_test
from dtwin.physics.shapes import refined
from dtwin.statistics import holm

ALPHA = 0.03
_MOST_STEPS = 4
# A travel has more to show at once than a circle: most of its errors keep their own places.
_MOST_STEPS_ALONG = 8
_LEADING = 6
_GROUP_GAIN = 0.5
_GROUP_P = 0.05
_FIT_IS_FINE = 0.05
# Smaller effects are not reported: the library's laws are not exact either.
IMMATERIAL = 0.08


@dataclass(frozen=True)
class Step:
    """One effect that was found, with its rivals.

    Attributes
    ----------
    problem : Problem
        The campaign before it was added.
    level : NoiseLevel
        Shared noise level at that point.
    top : Candidate
        The effect with the largest gain.
    group : tuple of Candidate
        It, and what these runs cannot tell from it, best first.
    p_values : dict of str to float
        After Holm, by label.
    tested : tuple of Candidate
        Everything that was tested.
    gains : dict of str to float
        Gain on left-out conditions of the leading candidates, by label.
    invisible : tuple of str
        Labels of the effects that nothing here can show.
    """

    problem: Problem
    level: NoiseLevel
    top: Candidate
    group: tuple[Candidate, ...]
    p_values: Mapping[str, float]
    tested: tuple[Candidate, ...]
    gains: Mapping[str, float]
    invisible: tuple[str, ...]


@dataclass(frozen=True)
class Search:
    """What a search found.

    Attributes
    ----------
    steps : tuple of Step
        Effects found, in order.
    last : Problem
        The campaign with all of them.
    tested : tuple of Candidate
        What was tested at the end, against what was left.
    p_values : dict of str to float
        Their p-values after Holm.
    invisible : tuple of str
        Labels of the effects that nothing here can show, at the start.
    lack_of_fit : tuple of float
        p-value at the start and after every step.
    systematic_um : tuple of float
        RMS of what repeats agree on, at the start and after every step.
    """

    steps: tuple[Step, ...]
    last: Problem
    tested: tuple[Candidate, ...]
    p_values: Mapping[str, float]
    invisible: tuple[str, ...]
    lack_of_fit: tuple[float, ...]
    systematic_um: tuple[float, ...]

    @property
    def explained(self) -> float:
        """Share of the systematic mean square, in um^2, that the effects found explain."""
        first, last = self.systematic_um[0], self.systematic_um[-1]
        return 1.0 - (last / first) ** 2 if first > 0.0 else 1.0


def search(
    problem: Problem,
    plain: Problem,
    candidates: Candidates,
    *,
    seed: int,
    shown_by_channel: bool = False,
) -> Search:
    """Add effects until nothing is significant or nothing is left to explain.

    Parameters
    ----------
    problem : Problem
        Whitened campaign with what the twin knows.
    plain : Problem
        The same without weights.
    candidates : Candidates
        The library.
    seed : int
        Seed of permutations.
    shown_by_channel : bool
        A logged channel was shown to move with the error: effects that act inside conditions
        are then compared among themselves only.
    """
    steps: list[Step] = []
    fits = [lack_of_fit(problem, problem.residual, seed)]
    systematic = [systematic_rms_um(problem.obs, in_angle(plain))]
    most = _MOST_STEPS_ALONG if problem.obs.grid.kind == "linear" else _MOST_STEPS
    while True:
        level = noise_level(problem, probes(problem))
        tested, invisible = candidates.tested(problem, level)
        p_values = adjusted(tested)
        if shown_by_channel:
            within = [c for c in tested if c.term.instance.effect.within_condition]
            p_values |= adjusted(within)
        significant = [
            c
            for c in tested
            if p_values[c.term.label] <= ALPHA and _is_material(plain, candidates, c, problem)
        ]
        step = _step(problem, candidates, level, tested, significant, p_values, tuple(invisible))
        if step is None or len(steps) == most:
            break
        steps.append(step)
        whitened = candidates.whitened(problem, step.top.term)
        problem = problem.extended(step.top.visible, whitened)
        unweighted = candidates.whitened(plain, step.top.term)
        plain = plain.extended(candidates.visible(plain, step.top.term), unweighted)
        fits.append(lack_of_fit(problem, problem.residual, seed))
        systematic.append(systematic_rms_um(problem.obs, in_angle(plain)))
        shown_by_channel = False
        if fits[-1] > _FIT_IS_FINE:
            tested, p_values = list(step.tested), dict(step.p_values)
            break
    first = steps[0].invisible if steps else tuple(invisible)
    return Search(
        tuple(steps), problem, tuple(tested), p_values, first, tuple(fits), tuple(systematic)
    )


def adjusted(tested: list[Candidate]) -> dict[str, float]:
    """Return Holm's adjusted p-values by label.

    Effects that these runs cannot tell apart are one test, not several: the number of tests is
    that of the independent ones.
    """
    ordered = sorted(tested, key=lambda c: c.score.p_value)
    p_values = holm([c.score.p_value for c in ordered], independent([c.visible for c in ordered]))
    return dict(zip((c.term.label for c in ordered), p_values.tolist(), strict=True))


def _step(
    problem: Problem,
    candidates: Candidates,
    level: NoiseLevel,
    tested: list[Candidate],
    significant: list[Candidate],
    p_values: Mapping[str, float],
    invisible: tuple[str, ...],
) -> Step | None:
    runs = int(problem.obs.run_of.max()) + 1
    leading = sorted(significant, key=lambda c: -_worth(c, runs))[:_LEADING]
    gains: dict[str, float] = {}
    top = None
    for found in leading:
        gain = left_out_gain(problem, candidates.whitened(problem, found.term))
        if top is None:
            # Between the shapes of the grid, what rings comes out of step at the other feeds.
            best = _refined(problem, candidates, found, level)
            if gain <= 0.0 and best is not found:
                gain = left_out_gain(problem, candidates.whitened(problem, best.term))
            top = best if gain > 0.0 else None
        gains[found.term.label] = gain
    if top is None:
        return None
    group = _group(problem, candidates, level, top, tested)
    return Step(problem, level, top, group, p_values, tuple(tested), gains, invisible)


def _worth(candidate: Candidate, runs: int) -> float:
    """Return the gain, less what every free parameter costs: Schwarz's criterion over runs."""
    k = candidate.visible.shape[1]
    free = k + len(candidate.term.instance.effect.shapes)
    return candidate.score.gain - candidate.score.expected / k * free * float(np.log(runs))


def _is_material(
    plain: Problem, candidates: Candidates, candidate: Candidate, problem: Problem
) -> bool:
    """Tell whether an effect would change the reading by more than a share of the noise floor."""
    floor_um = problem.noise.floor_um if problem.noise is not None else 0.0
    visible = candidates.visible(plain, candidate.term)
    total = float(((visible.T @ plain.residual.ravel()) ** 2).sum())
    return float((total / plain.obs.mask.sum()) ** 0.5) >= IMMATERIAL * floor_um


def _group(
    problem: Problem,
    candidates: Candidates,
    level: NoiseLevel,
    top: Candidate,
    tested: list[Candidate],
) -> tuple[Candidate, ...]:
    """Return what leaves the top one nothing significant to explain: a 95 % confidence set."""
    group = [top]
    for found in sorted(tested, key=lambda c: -c.score.gain):
        if found.term.label == top.term.label:
            continue
        if found.score.gain < _GROUP_GAIN * top.score.gain:
            continue
        other = _refined(problem, candidates, found, level)
        if _adds_nothing(problem, top, other, candidates, level):
            group.append(other)
    return tuple(group)


def _refined(
    problem: Problem, candidates: Candidates, candidate: Candidate, level: NoiseLevel
) -> Candidate:
    term = refined(problem, candidate.term, bounded=True)
    if term is candidate.term:
        return candidate
    return candidates.at(problem, candidate, term, level)


def _adds_nothing(
    problem: Problem,
    top: Candidate,
    other: Candidate,
    candidates: Candidates,
    level: NoiseLevel,
) -> bool:
    given = problem.extended(other.visible, candidates.whitened(problem, other.term))
    left = candidates.visible(given, top.term)
    if not left.shape[1]:
        return True
    within = top.term.instance.effect.within_condition
    score = score_test(given, left, given.residual, level, within=within)
    return score.p_value > _GROUP_P
