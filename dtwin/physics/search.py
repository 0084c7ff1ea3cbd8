"""Find the effects that repeats agree on, all together, until what is left is not significant."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dtwin.physics.candidates import Candidate, Candidates, independent, probes
from dtwin.physics.cross_validation import left_out_gain
from dtwin.physics.dictionary import Dictionary, Entry
from dtwin.physics.hunt import best_set
from dtwin.physics.localise import in_angle, systematic_rms_um
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Problem, Term, least_visible, unweighted, weighted_like
from dtwin.physics.score import NoiseLevel, lack_of_fit, misfit, noise_level, score_test
from dtwin.physics.shapes import refined
from dtwin.schema import Floats
from dtwin.statistics import holm

ALPHA = 0.03
_LEADING = 6
_GROUP_GAIN = 0.5
# Between the shapes of the grid an effect may explain more.
_NEAR = 0.3
_GROUP_P = 0.05
_FIT_IS_FINE = 0.05
# Smaller effects are not reported: the library's laws are not exact either.
IMMATERIAL = 0.08
_INEXACT = 0.05
# A simpler effect stands in for another one when it loses no more than this of what that explains.
_STANDS_IN = 0.05
# p-values so small stay significant whatever the number of tests.
_BEYOND_DOUBT = 1e-6


@dataclass(frozen=True, eq=False)
class Found:
    """One effect that was found, with its rivals.

    Attributes
    ----------
    top : Candidate
        The effect, tested against what all the others leave.
    group : tuple of Candidate
        It, and what these runs cannot tell from it, best first.
    absorbed : frozenset of str
        Those of the group that cannot be seen beside the effect: they may be there as well.
    problem : Problem
        The campaign with all the other effects that were found.
    candidates : Candidates
        The library where it was tested.
    level : NoiseLevel
        Shared noise level there.
    gain : float
        Gain on conditions that were left out.
    size_um : float
        RMS of what it explains beside all the others.
    fitted_um : ndarray, shape (rows, n)
        What it does.
    """

    top: Candidate
    group: tuple[Candidate, ...]
    absorbed: frozenset[str]
    problem: Problem
    candidates: Candidates
    level: NoiseLevel
    gain: float
    size_um: float
    fitted_um: Floats

    @property
    def label(self) -> str:
        """Name with axis."""
        return self.top.term.label


@dataclass(frozen=True)
class Test:
    """Every effect of the library against what a set of effects leaves.

    Attributes
    ----------
    problem : Problem
        The campaign with the set.
    level : NoiseLevel
        Shared noise level.
    candidates : tuple of Candidate
        Visible effects.
    p_values : dict of str to float
        After Holm, by label.
    invisible : tuple of str
        Labels of the effects that nothing here can show.
    """

    problem: Problem
    level: NoiseLevel
    candidates: tuple[Candidate, ...]
    p_values: Mapping[str, float]
    invisible: tuple[str, ...]


@dataclass(frozen=True)
class Search:
    """What a search found.

    Attributes
    ----------
    found : tuple of Found
        Effects, the one that explains most first.
    first : Test
        The library against what was known before.
    last, plain : Problem
        The campaign with all of them, whitened and without weights.
    lack_of_fit : tuple of float
        p-value at the start and at the end.
    systematic_um : tuple of float
        RMS of what repeats agree on, at the start and at the end.
    """

    found: tuple[Found, ...]
    first: Test
    last: Problem
    plain: Problem
    lack_of_fit: tuple[float, float]
    systematic_um: tuple[float, float]

    @property
    def explained(self) -> float:
        """Share of the systematic mean square, in um^2, that the effects found explain."""
        first, last = self.systematic_um
        return 1.0 - (last / first) ** 2 if first > 0.0 else 1.0


def search(
    problem: Problem,
    plain: Problem,
    candidates: Candidates,
    known: Sequence[Term],
    *,
    beside: Callable[[Problem], Problem],
    seed: int,
    shown_by_channel: bool = False,
) -> Search:
    """Find the set of effects that explains a campaign, and test each beside all the others.

    Parameters
    ----------
    problem : Problem
        Whitened campaign with what the twin knows.
    plain : Problem
        The same without weights.
    candidates : Candidates
        The library.
    known : sequence of Term
        What the twin knows.
    beside : callable
        Takes out of a problem what is neither the twin's nor the library's.
    seed : int
        Seed of permutations.
    shown_by_channel : bool
        A logged channel was shown to move with the error: effects that act inside conditions
        are then compared among themselves only.
    """
    first = _tested(problem, candidates, shown_by_channel)
    fit = lack_of_fit(problem, problem.residual, seed)
    before_um = systematic_rms_um(problem.obs, in_angle(plain))
    top = _leading(first, plain, candidates)
    terms: list[Term] = []
    stand_ins: dict[str, list[Term]] = {}
    told, library = problem, candidates
    if top is not None or fit <= _FIT_IS_FINE:
        terms, obs = best_set(problem, candidates, known, beside)
        terms, stand_ins = _material(terms, obs, known, candidates, problem)
        if obs is not problem.obs and problem.noise is not None:
            told, library = (
                beside(weighted_like(obs, known, problem.noise)),
                Candidates(obs, candidates.instances),
            )
        terms = _significant(terms or ([top.term] if top else []), told, library, first)
        if not terms and top is not None:
            terms = [top.term]
    last, plain_last = _given(problem, terms, candidates), _given(plain, terms, candidates)
    found = _described(terms, stand_ins, told, library, problem, plain, candidates)
    end = lack_of_fit(last, last.residual, seed) if terms else fit
    left_um = systematic_rms_um(problem.obs, in_angle(plain_last))
    return Search(found, first, last, plain_last, (fit, end), (before_um, left_um))


def adjusted(tested: Sequence[Candidate]) -> dict[str, float]:
    """Return Holm's adjusted p-values by label.

    Effects that these runs cannot tell apart are one test, not several: the number of tests is
    that of the independent ones.
    """
    ordered = sorted(tested, key=lambda c: c.score.p_value)
    p_values = holm([c.score.p_value for c in ordered], independent([c.visible for c in ordered]))
    return dict(zip((c.term.label for c in ordered), p_values.tolist(), strict=True))


def _given(problem: Problem, terms: Sequence[Term], candidates: Candidates) -> Problem:
    """Return a problem with further effects known."""
    for term in terms:
        visible = candidates.visible(problem, term)
        problem = problem.extended(visible, candidates.whitened(problem, term))
    return problem


def _tested(problem: Problem, candidates: Candidates, shown_by_channel: bool) -> Test:
    level = noise_level(problem, probes(problem))
    tested, invisible = candidates.tested(problem, level)
    p_values = adjusted(tested)
    if shown_by_channel:
        within = [c for c in tested if c.term.instance.effect.within_condition]
        p_values |= adjusted(within)
    return Test(problem, level, tuple(tested), p_values, tuple(invisible))


def _leading(test: Test, plain: Problem, candidates: Candidates) -> Candidate | None:
    """Return the significant effect that is worth most and foretells conditions left out."""
    problem = test.problem
    significant = [
        c
        for c in test.candidates
        if test.p_values[c.term.label] <= ALPHA and _is_material(plain, candidates, c.term, problem)
    ]
    runs = int(problem.obs.run_of.max()) + 1
    for found in sorted(significant, key=lambda c: -_worth(c, runs))[:_LEADING]:
        gain = left_out_gain(problem, candidates.whitened(problem, found.term))
        # Between the shapes of the grid, what rings comes out of step at the other feeds.
        best = _refined(problem, candidates, found, test.level)
        if gain <= 0.0 and best is not found:
            gain = left_out_gain(problem, candidates.whitened(problem, best.term))
        if gain > 0.0:
            return best
    return None


def _worth(candidate: Candidate, runs: int) -> float:
    """Return the gain, less what every free parameter costs: Schwarz's criterion over runs."""
    k = candidate.visible.shape[1]
    free = k + len(candidate.term.instance.effect.shapes)
    return candidate.score.gain - candidate.score.expected / k * free * float(np.log(runs))


def _is_material(plain: Problem, candidates: Candidates, term: Term, problem: Problem) -> bool:
    """Tell whether an effect would change the reading by more than a share of the noise floor."""
    return _size_um(plain, candidates, term) >= IMMATERIAL * _floor_um(problem)


def _floor_um(problem: Problem) -> float:
    return problem.noise.floor_um if problem.noise is not None else 0.0


def _size_um(plain: Problem, candidates: Candidates, term: Term) -> float:
    """Return the RMS of what an effect would explain."""
    visible = candidates.visible(plain, term)
    total = float(((visible.T @ plain.residual.ravel()) ** 2).sum())
    return float((total / plain.obs.mask.sum()) ** 0.5)


def _material(
    terms: Sequence[Term],
    obs: Observations,
    known: Sequence[Term],
    candidates: Candidates,
    problem: Problem,
) -> tuple[list[Term], dict[str, list[Term]]]:
    """Return the effects that are more than how far the laws of others are off, and their stand-ins.

    Every effect must explain a twentieth of what all explain, as RMS. A stand-in, by the label of
    the effect, is a simpler effect that loses no more in its place than laws are off.
    """
    if not terms:
        return [], {}
    dictionary = Dictionary(unweighted(obs, known), Candidates(obs, candidates.instances))
    found = dictionary.add(terms)
    floor = (IMMATERIAL * _floor_um(problem)) ** 2 * float(obs.mask.sum())
    least = max(floor, _INEXACT**2 * dictionary.explained(found))
    chosen = _worthwhile(dictionary, found, least)
    stand_ins = {e.label: _stand_ins(dictionary, chosen, e, least) for e in chosen}
    return [entry.term for entry in chosen], stand_ins


def _stand_ins(
    dictionary: Dictionary, chosen: list[Entry], entry: Entry, least: float
) -> list[Term]:
    rest = [e for e in chosen if e is not entry]
    have = {e.label for e in chosen}
    own = dictionary.explained(chosen) - dictionary.explained(rest)
    enough = own - min(least, _STANDS_IN * own)
    gains = zip(dictionary.gains(rest).tolist(), dictionary.entries, strict=True)
    near = [
        (gain, other)
        for gain, other in gains
        if gain > enough and other.free < entry.free and other.label not in have
    ]
    # The best shape of each: the last one wins.
    best = {other.label: other.term for _, other in sorted(near, key=lambda pair: pair[0])}
    return list(best.values())


def _worthwhile(dictionary: Dictionary, found: list[Entry], least: float) -> list[Entry]:
    """Return the best of the effects found where each must explain so much: drop, add and exchange."""

    def worth(entries: list[Entry]) -> float:
        return dictionary.explained(entries) - least * len(entries)

    chosen, most = found, worth(found)
    while True:
        rest = [e for e in found if e not in chosen]
        fewer = [chosen[:i] + chosen[i + 1 :] for i in range(len(chosen))]
        moves = [*fewer, *([*entries, e] for entries in [chosen, *fewer] for e in rest)]
        best = max(moves, key=worth, default=chosen)
        if worth(best) <= most:
            return chosen
        chosen, most = best, worth(best)


def _significant(
    terms: Sequence[Term], problem: Problem, candidates: Candidates, first: Test
) -> list[Term]:
    """Return the effects without those that are not significant beside all the others."""
    terms = list(terms)
    many = independent([c.visible for c in first.candidates])
    while terms:
        p_values = []
        beyond = misfit(_given(problem, terms, candidates))
        for term in terms:
            given = _given(problem, [t for t in terms if t is not term], candidates)
            level = replace(noise_level(given, probes(given)), misfit=beyond)
            candidate = candidates.tested_term(given, term, level)
            p_value = 1.0 if candidate is None else candidate.score.p_value
            if _BEYOND_DOUBT < p_value < ALPHA:
                shapes = candidates.tested_instance(given, term.instance, level)
                p_value = min(1.0, many * (1.0 if shapes is None else shapes.score.p_value))
            p_values.append(p_value)
        worst = int(np.argmax(p_values))
        if p_values[worst] <= ALPHA:
            break
        del terms[worst]
    return terms


def _described(
    terms: Sequence[Term],
    stand_ins: Mapping[str, Sequence[Term]],
    problem: Problem,
    candidates: Candidates,
    whole: Problem,
    plain: Problem,
    everywhere: Candidates,
) -> tuple[Found, ...]:
    """Return effects with their rivals, the one that explains most first.

    Tests are made where laws hold to within the noise. Sizes are told everywhere, and a rival must
    not be ruled out there either.
    """
    out = []
    beyond = misfit(_given(problem, terms, candidates))
    rough = NoiseLevel(misfit=misfit(_given(whole, terms, everywhere)))
    dictionary = Dictionary(problem, candidates)
    chosen = {entry.label: entry for entry in dictionary.add(terms)}
    for term in terms:
        others = [t for t in terms if t is not term]
        given = _given(problem, others, candidates)
        level = replace(noise_level(given, probes(given)), misfit=beyond)
        top = candidates.tested_term(given, term, level)
        if top is None:
            continue
        rivals, _ = candidates.tested(given, level, but=_far(dictionary, chosen, term))
        bare = _given(plain, others, everywhere)
        group, absorbed = _group(given, candidates, level, top, rivals)
        if whole is not problem:
            beside = _given(whole, others, everywhere)
            group = group[:1] + tuple(
                c
                for c in group[1:]
                if c.term.label in absorbed or _adds_nothing(beside, top, c, everywhere, rough)
            )
        have = {c.term.label for c in group}
        simpler = [t for t in stand_ins.get(term.label, ()) if t.label not in have]
        tested = [candidates.tested_term(given, t, level) for t in simpler]
        group += tuple(c for c in tested if c is not None)
        group += _sets(problem, candidates, terms, term, rivals, group, level)
        gain = left_out_gain(given, candidates.whitened(given, term))
        visible = everywhere.visible(bare, term)
        fitted = (visible @ (visible.T @ bare.residual.ravel())).reshape(bare.residual.shape)
        size_um = _size_um(bare, everywhere, term)
        out.append(Found(top, group, absorbed, given, candidates, level, gain, size_um, fitted))
    return tuple(sorted(out, key=lambda f: -f.size_um))


def _far(dictionary: Dictionary, chosen: Mapping[str, Entry], term: Term) -> set[str]:
    """Return the labels of what is no rival of a term: it explains too little in its place."""
    rest = [entry for label, entry in chosen.items() if label != term.label]
    gains = dictionary.gains(rest)
    own = dictionary.explained(list(chosen.values())) - dictionary.explained(rest)
    most: dict[str, float] = {}
    for gain, entry in zip(gains, dictionary.entries, strict=True):
        most[entry.label] = max(most.get(entry.label, 0.0), float(gain))
    return {
        entry.label
        for entry in dictionary.entries
        if entry.label in chosen
        or (
            most[entry.label] < _NEAR * own
            and entry.term.instance.effect.name not in term.instance.effect.confusables
        )
    }


def _group(
    problem: Problem,
    candidates: Candidates,
    level: NoiseLevel,
    top: Candidate,
    tested: Sequence[Candidate],
) -> tuple[tuple[Candidate, ...], frozenset[str]]:
    """Return what cannot be told from the top effect, and the labels of what cannot be seen beside it.

    What leaves it nothing significant to explain, a 95 % confidence set; and what is simpler,
    explains half as much alone and nothing beside it: how much of the two is there is not known.
    """
    group, hidden = [top], set()
    beside = problem.extended(top.visible, candidates.whitened(problem, top.term))
    for found in sorted(tested, key=lambda c: -c.score.gain):
        if found.score.gain < _GROUP_GAIN * top.score.gain:
            continue
        other = _refined(problem, candidates, found, level)
        invisible = not candidates.visible(beside, other.term).shape[1]
        if invisible and _numbers(other.term) < _numbers(top.term):
            hidden.add(other.term.label)
        elif not _adds_nothing(problem, top, other, candidates, level):
            continue
        group.append(other)
    return tuple(group), frozenset(hidden)


def _numbers(term: Term) -> int:
    effect = term.instance.effect
    return len(effect.parameters) + len(effect.shapes)


def _sets(
    problem: Problem,
    candidates: Candidates,
    terms: Sequence[Term],
    term: Term,
    rivals: Sequence[Candidate],
    group: Sequence[Candidate],
    level: NoiseLevel,
) -> tuple[Candidate, ...]:
    """Return what only together with its like on other axes is a rival of an effect, or of its likes.

    Three lobes of a cup are two bowed guideways at one radius: neither bow alone is its rival, nor is
    the cup one of either bow alone.
    """
    name = term.instance.effect.name
    own = [t for t in terms if t.instance.effect.name == name]
    given = _given(problem, [t for t in terms if t not in own], candidates)
    have = {c.term.label for c in group}
    out: list[Candidate] = []
    for other in term.instance.effect.confusables:
        like = [c for c in rivals if c.term.instance.effect.name == other]
        numbers = sum(_numbers(c.term) for c in like)
        # What needs more numbers is no plainer explanation.
        if len(like) + len(own) < 3 or not 0 < numbers <= sum(map(_numbers, own)):
            continue
        with_them = _given(given, [c.term for c in like], candidates)
        whitened = np.concatenate([candidates.whitened(given, t) for t in own], axis=1)
        left, _ = with_them.visible(whitened, least=least_visible(term))
        within = term.instance.effect.within_condition
        if not left.shape[1] or (
            score_test(with_them, left, with_them.residual, level, within=within).p_value > _GROUP_P
        ):
            out += [c for c in like if c.term.label not in have]
    return tuple(out)


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
    visible = candidates.visible(problem, other.term)
    given = problem.extended(visible, candidates.whitened(problem, other.term))
    left = candidates.visible(given, top.term)
    if not left.shape[1]:
        return True
    within = top.term.instance.effect.within_condition
    score = score_test(given, left, given.residual, level, within=within)
    return score.p_value > _GROUP_P
