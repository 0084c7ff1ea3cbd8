"""What is unknown, as scaling laws without a name that take part in the search among sets of effects."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from dtwin.physics._dictionary import Dictionary
from dtwin.physics._hunt import Hunt
from dtwin.physics._law_search import LawKey, law_keys
from dtwin.physics._local_laws import MOST_TARGETS, local_laws
from dtwin.physics.candidates import Candidates
from dtwin.physics.effect import Instance
from dtwin.physics.learned import law_size, learned_effect, name_of
from dtwin.physics.learned_places import LEARNED
from dtwin.physics.problem import INVISIBLE, Problem, Term, orthonormal, squares
from dtwin.schema import Floats

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


def simpler_law(problem: Problem, candidates: Candidates, found: Sequence[Term]) -> tuple[list[Term], list[Term]]:
    """Return the law that in place of one or two effects leaves less with fewer numbers, and the other effects; nothing where none does.

    ``problem``: whitened campaign with what the twin knows.
    """
    laws = Dictionary(problem, candidates.only(_offered(problem, candidates)))
    many = len(laws.entries)
    chosen = laws.add(found)
    all_explain, best = laws.explained(chosen), None
    for dropped in itertools.chain.from_iterable(itertools.combinations(chosen, n) for n in (1, 2)):
        rest = [entry for entry in chosen if entry not in dropped]
        gains = np.where(
            [e.free < sum(d.free for d in dropped) for e in laws.entries[:many]], laws.gains(rest)[:many], 0.0
        )
        number = int(np.argmax(gains))
        explain = laws.explained(rest) + float(gains[number])
        if explain > all_explain:
            all_explain, best = explain, (laws.entries[number], rest)
    return ([], []) if best is None else ([best[0].term], [entry.term for entry in best[1]])


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
