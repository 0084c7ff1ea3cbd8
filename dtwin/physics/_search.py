"""Find the effects that repeats agree on, all together, until what is left is not significant."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dtwin.physics._best_set import Best, best_set
from dtwin.physics._best_shapes import in_best_shape, in_best_shapes
from dtwin.physics._dictionary import Dictionary
from dtwin.physics._hunt import without_bends
from dtwin.physics._material import IMMATERIAL, Material, floor_um, hidden_by_mask, weighed
from dtwin.physics._rivals import Found, described, level_beside, refined_candidate
from dtwin.physics._score import NoiseLevel, lack_of_fit, noise_level
from dtwin.physics.candidates import Candidate, Candidates, independent, probes
from dtwin.physics.cross_validation import left_out_gain
from dtwin.physics.localise import in_angle, systematic_rms_um
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Problem, Term, weighted_like
from dtwin.progress import tell
from dtwin.statistics import holm

_ALPHA = 0.03
_LEADING = 6
_FIT_IS_FINE = 0.05
# p-values so small stay significant whatever the number of tests.
_BEYOND_DOUBT = 1e-6


@dataclass(frozen=True)
class _Test:
    """Every effect of the library against what a set of effects leaves.

    ``dictionary``: the library beside what is known.
    ``p_values``: after Holm, by label.
    ``invisible``: labels of the effects that nothing here can show.
    """

    dictionary: Dictionary
    level: NoiseLevel
    candidates: tuple[Candidate, ...]
    p_values: Mapping[str, float]
    invisible: tuple[str, ...]

    @property
    def problem(self) -> Problem:
        """The campaign with what is known."""
        return self.dictionary.problem


@dataclass(frozen=True)
class Search:
    """What a search found.

    ``found``: effects, the one that explains most first.
    ``first``: the library against what was known before.
    ``last``, ``plain``: the campaign with all of them, whitened and without weights.
    ``lack_of_fit``: p-value at the start and at the end.
    ``systematic_um``: RMS of what repeats agree on, at the start and at the end.
    ``best``: what the search among sets of effects gave; None when it was not needed.
    ``if_inexact``: what of it would be looked at if laws that were taken to be exact are not; None where that is the same.
    ``untold``: labels of effects that move between too few runs to be told, and that the others were tested beside.
    """

    found: tuple[Found, ...]
    first: _Test
    last: Problem
    plain: Problem
    lack_of_fit: tuple[float, float]
    systematic_um: tuple[float, float]
    best: Best | None
    if_inexact: Material | None
    untold: tuple[str, ...] = ()

    @property
    def explained(self) -> float:
        """Share of the systematic mean square, in um^2, that the effects found explain."""
        first, last = self.systematic_um
        return 1.0 - (last / first) ** 2 if first > 0.0 else 1.0


def search_effects(
    problem: Problem,
    plain: Problem,
    candidates: Candidates,
    known: Sequence[Term],
    *,
    beside: Callable[[Problem], Problem],
    seed: int,
    shown_by_channel: bool = False,
    before: Search | None = None,
) -> Search:
    """Find the set of effects that explains a campaign, and test each beside all the others.

    ``problem``: whitened campaign with what the twin knows.
    ``plain``: the same without weights.
    ``beside``: takes out of a problem what is neither the twin's nor the library's.
    ``shown_by_channel``: a logged channel was shown to move with the error: effects that act inside conditions are then
    compared among themselves only.
    ``before``: the search that took laws to be exact which are not.
    """
    first = before.first if before else _tested(problem, candidates, shown_by_channel)
    fit = before.lack_of_fit[0] if before else lack_of_fit(problem, problem.residual, seed)
    before_um = systematic_rms_um(problem.obs, in_angle(plain))
    top = _leading(first, plain, candidates)
    terms: list[Term] = []
    sharp: list[Term] = []
    untold: list[Term] = []
    stand_ins: dict[str, list[Term]] = {}
    told, library = problem, candidates
    best = if_inexact = None
    if top is not None or fit <= _FIT_IS_FINE:
        tell(f"{problem.obs.campaign.name}: sets of effects")
        best = before.best if before and before.best else best_set(problem, first.dictionary, known, beside)
        library, obs = best.library, best.library.obs
        if before and before.if_inexact:
            terms, stand_ins = before.if_inexact
        else:
            material = weighed(best.terms, known, library, problem)
            terms, stand_ins = material(best.exact)
            if best.exact and (other := material(False)) != (terms, stand_ins):
                if_inexact = other
        if obs is not problem.obs and problem.noise is not None:
            told = beside(weighted_like(obs, known, problem.noise))
        terms = without_bends(terms, told, library)
        terms, untold = _told(terms or ([top.term] if top else []), told, library, first)
        told, problem, plain = (candidates.given(each, untold) for each in (told, problem, plain))
        if not terms and top is not None:
            terms = [top.term]
        if told is not problem:
            beside_them = candidates.given(problem, terms)
            sharp = hidden_by_mask(best.everywhere, terms, obs, known, problem)
            sharp = _significant(sharp, beside_them, candidates, first)
    tell(f"{problem.obs.campaign.name}: {len(terms) + len(sharp)} effects, each beside the others")
    effects = _described(terms, sharp, stand_ins, told, library, problem, plain, candidates)
    terms = [*terms, *sharp]
    last, plain_last = candidates.given(problem, terms), candidates.given(plain, terms)
    end = lack_of_fit(last, last.residual, seed) if terms else fit
    left_um = systematic_rms_um(problem.obs, in_angle(plain_last))
    return Search(
        effects,
        first,
        last,
        plain_last,
        (fit, end),
        (before_um, left_um),
        best,
        if_inexact,
        tuple(t.label for t in untold),
    )


def _described(
    terms: list[Term],
    sharp: list[Term],
    stand_ins: dict[str, list[Term]],
    told: Problem,
    library: Candidates,
    problem: Problem,
    plain: Problem,
    candidates: Candidates,
) -> tuple[Found, ...]:
    """Return what was found away from reversals, and beside it what happens at reversals."""
    effects = (
        described(
            terms,
            stand_ins,
            library.given(told, sharp),
            library,
            candidates.given(problem, sharp),
            candidates.given(plain, sharp),
            candidates,
        )
        if sharp
        else described(terms, stand_ins, told, library, problem, plain, candidates)
    )
    if not sharp:
        return effects
    beside = candidates.given(problem, terms)
    at = described(sharp, {}, beside, candidates, beside, candidates.given(plain, terms), candidates)
    return tuple(sorted([*effects, *at], key=lambda f: -f.size_um))


def adjusted(tested: Sequence[Candidate], obs: Observations) -> dict[str, float]:
    """Return Holm's adjusted p-values by label.

    Effects that these runs cannot tell apart are one test, not several: the number of tests is
    that of the independent ones.
    """
    ordered = sorted(tested, key=lambda c: c.score.p_value)
    p_values = holm([c.score.p_value for c in ordered], independent([c.visible for c in ordered], obs))
    return dict(zip((c.term.label for c in ordered), p_values.tolist(), strict=True))


def _tested(problem: Problem, candidates: Candidates, shown_by_channel: bool) -> _Test:
    level = noise_level(problem, probes(problem))
    dictionary = Dictionary(problem, candidates)
    tested, invisible = in_best_shapes(dictionary, [], problem, level)
    p_values = adjusted(tested, problem.obs)
    if shown_by_channel:
        within = [c for c in tested if c.term.instance.effect.within_condition]
        p_values |= adjusted(within, problem.obs)
    return _Test(dictionary, level, tuple(tested), p_values, tuple(invisible))


def _leading(test: _Test, plain: Problem, candidates: Candidates) -> Candidate | None:
    """Return the significant effect that is worth most and foretells conditions left out."""
    problem = test.problem
    significant = [
        c
        for c in test.candidates
        if test.p_values[c.term.label] <= _ALPHA and _is_material(plain, candidates, c.term, problem)
    ]
    runs = int(problem.obs.run_of.max()) + 1
    for candidate in sorted(significant, key=lambda c: -_worth(c, runs, problem.obs.several_speeds))[:_LEADING]:
        gain = left_out_gain(problem, candidates.whitened(problem, candidate.term))
        # Between the shapes of the grid, what rings comes out of step at the other feeds.
        best = refined_candidate(problem, test.dictionary.campaign, candidates, candidate, test.level)
        if gain <= 0.0 and best is not candidate:
            gain = left_out_gain(problem, candidates.whitened(problem, best.term))
        if gain > 0.0:
            return best
    return None


def _worth(candidate: Candidate, runs: int, several_speeds: bool) -> float:
    """Return the gain, less what every free parameter costs: Schwarz's criterion over runs."""
    k = candidate.visible.shape[1]
    free = k + len(candidate.term.instance.effect.refined_shapes(several_speeds))
    return candidate.score.gain - candidate.score.expected / k * free * float(np.log(runs))


def _is_material(plain: Problem, candidates: Candidates, term: Term, problem: Problem) -> bool:
    """Tell whether an effect would change the reading by more than a share of the noise floor."""
    return candidates.size_um(plain, term) >= IMMATERIAL * floor_um(problem)


def _told(
    terms: Sequence[Term], problem: Problem, candidates: Candidates, first: _Test
) -> tuple[list[Term], list[Term]]:
    """Return the effects that are significant, and those that few runs do not tell but that others are tested beside.

    What moves between three runs has hardly a degree of freedom to be told by, and left alone it is noise of all that stays.
    """
    moving = [t for t in terms if t.instance.effect.within_condition and problem.obs.there_and_back]
    staying = [t for t in terms if t not in moving]
    staying = _significant(staying, candidates.given(problem, moving), candidates, first)
    told = _significant(moving, candidates.given(problem, staying), candidates, first)
    return [*staying, *told], [t for t in moving if t not in told]


def _significant(terms: Sequence[Term], problem: Problem, candidates: Candidates, first: _Test) -> list[Term]:
    """Return the effects without those that are not significant beside all the others."""
    terms = list(terms)
    many = independent([c.visible for c in first.candidates], problem.obs)
    # What effects leave that were taken out before is no misfit of the library.
    level = level_beside(candidates.given(problem, terms))
    while terms:
        p_values = []
        for term in terms:
            given = candidates.given(problem, [t for t in terms if t is not term])
            candidate = candidates.tested_term(given, term, level)
            p_value = 1.0 if candidate is None else candidate.score.p_value
            if _BEYOND_DOUBT < p_value < _ALPHA:
                alone = Dictionary(given, candidates.only([term.instance]))
                shapes = in_best_shape(alone, [], given, term.instance, level)
                p_value = min(1.0, many * (1.0 if shapes is None else shapes.score.p_value))
            p_values.append(p_value)
        worst = int(np.argmax(p_values))
        if p_values[worst] <= _ALPHA:
            break
        del terms[worst]
    return terms
