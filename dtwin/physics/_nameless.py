"""What is unknown, as scaling laws without a name that take part in the search among sets of effects."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from dtwin.physics._dictionary import Dictionary, Entry, dictionary_for
from dtwin.physics._hunt import Hunt
from dtwin.physics._law_search import LawKey, law_keys
from dtwin.physics._learned_places import LEARNED
from dtwin.physics._local_laws import MOST_TARGETS, local_laws
from dtwin.physics.candidates import Candidates
from dtwin.physics.effect import Instance
from dtwin.physics.learned import law_size, learned_effect, name_of
from dtwin.physics.problem import INVISIBLE, Problem, Term, orthonormal, squares
from dtwin.physics.whitening import harmonic_numbers
from dtwin.schema import Floats

# Numbers of a law: cosine and sine of one harmonic.
_OF_A_LAW = 2
# Of what the library alone leaves, by laws of one place beside it.
_CLEARLY = 0.5


def nameless(problem: Problem, candidates: Candidates, believed: Sequence[Term]) -> list[Term]:
    """Return the laws of the best set of effects of the library and laws without a name.

    The library alone explains what is unknown as well as it can, and the laws of what is really there then
    seem to be broken. Laws that effects of the library make together are not offered.

    ``problem``: whitened campaign with what the twin knows.
    ``believed``: effects that were found without laws; they stay in the set.
    """
    offered = _offered(problem, candidates)
    have = {term.label for term in believed}
    rest = [i for i in candidates.instances if i.label not in have]
    beside = candidates.given(problem, believed)
    chosen = Hunt(beside, Dictionary(beside, candidates.only([*rest, *offered]))).run([])
    return [entry.term for entry in chosen if entry.term.instance in offered]


def simpler_law(problem: Problem, candidates: Candidates, terms: Sequence[Term]) -> tuple[list[Term], list[Term]]:
    """Return the law that in place of one or two effects leaves less with fewer numbers, and the other effects; nothing where none does.

    ``problem``: whitened campaign with what the twin knows.
    """
    few = dictionary_for(problem, terms)
    chosen = few.add(terms)
    all_explain, best = few.explained(chosen), None
    # Most effects have more harmonics than one law: no law needs to be tried in their place.
    rests = [rest for rest in _with_two_less(chosen) if few.explained(rest) + _in_one_harmonic(few, rest) > all_explain]
    if not rests:
        return [], []
    differ = [t.instance for t in terms if not candidates.obs.is_alike_in_repeats(t.instance)]
    laws = Dictionary(problem, candidates.only([*differ, *_offered(problem, candidates)]))
    numbers = [n for n, entry in enumerate(laws.entries) if entry.term.instance.effect.source == LEARNED]
    there = {entry.label: entry for entry in laws.add(terms)}
    for rest in rests:
        beside = [there[entry.label] for entry in rest if entry.label in there]
        gains = laws.gains(beside)
        number = max(numbers, key=gains.__getitem__, default=None)
        if number is not None and (explain := laws.explained(beside) + float(gains[number])) > all_explain:
            all_explain, best = explain, ([laws.entries[number].term], [entry.term for entry in beside])
    return best or ([], [])


def _with_two_less(chosen: Sequence[Entry]) -> list[list[Entry]]:
    """Return a set without each one and each two effects that have more numbers than a law has."""
    dropped = [d for n in (1, 2) for d in itertools.combinations(chosen, n) if sum(e.free for e in d) > _OF_A_LAW]
    return [[entry for entry in chosen if entry not in d] for d in dropped]


def _in_one_harmonic(dictionary: Dictionary, chosen: Sequence[Entry]) -> float:
    """Return the most that a set leaves in one harmonic, as a sum of squares."""
    obs = dictionary.problem.obs
    left = (dictionary.problem.residual.ravel() - dictionary.fitted(chosen)).reshape(obs.n_rows, obs.n_bins)
    return float(np.bincount(harmonic_numbers(obs.n_bins), (left**2).sum(axis=0)).max())


def local(problem: Problem, candidates: Candidates) -> list[Term]:
    """Return laws of one place beside which effects of no more numbers leave an axis clearly less than the library alone.

    A door that catches and a dent are, to the library, a curve beside a worn stretch, of many numbers.

    ``problem``: whitened campaign with what the twin knows.
    """
    if candidates.obs.n_bins > MOST_TARGETS:
        return []
    offered = candidates.only([*candidates.instances, *local_laws(candidates.obs)])
    hunt, alone = (Hunt(problem, Dictionary(problem, library)) for library in (offered, candidates))
    chosen = hunt.run([])
    laws = [entry.term for entry in chosen if entry.term.instance.effect.source == LEARNED]
    if not laws:
        return []
    without = alone.run([])
    more = sum(entry.free for entry in chosen) - sum(entry.free for entry in without)
    simpler = more < 0 and hunt.leaves_noise(chosen)
    return laws if simpler or (more <= 1 and hunt.left(chosen) < _CLEARLY * alone.left(without)) else []


def _offered(problem: Problem, candidates: Candidates) -> list[Instance]:
    """Return the laws without those that effects of the library without shapes make together."""
    plain = [candidates.whitened(problem, Term(i)) for i in candidates.instances if not i.effect.shapes]
    # A twin may know all of them already.
    made = orthonormal(_unit(np.concatenate([np.empty((problem.y.size, 0)), *plain], axis=1)))
    offered = []
    for law in _laws(candidates):
        columns = _unit(candidates.whitened(problem, law))
        if (squares(columns - made @ (made.T @ columns)) > INVISIBLE).any():
            offered.append(law.instance)
    return offered


def _laws(candidates: Candidates) -> list[Term]:
    """Return the terms of all laws, their columns evaluated: those of one harmonic are multiples of each other."""
    obs = candidates.obs
    out = []
    for key in law_keys(obs):
        waves = _term((key[0], False, 0.0, 0.0))
        rows, of = candidates.harmonics(waves)
        row = np.unique(of, return_index=True)[1]
        size = law_size(key, obs.feed_mm_s[row], obs.radius_mm[row], obs.sense[row])
        term = _term(key)
        candidates.take_in(term, rows * np.asarray(size)[:, None, None], of)
        out.append(term)
    return out


def _term(key: LawKey) -> Term:
    return Term(Instance(learned_effect(name_of(key))))


def _unit(columns: Floats) -> Floats:
    size = np.sqrt(squares(columns))
    return np.asarray(columns[:, size > 0.0] / size[size > 0.0])
