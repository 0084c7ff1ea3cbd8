"""Which of the effects found are more than how far the laws of others are off."""

from __future__ import annotations

from collections.abc import Sequence

from dtwin.physics.candidates import Candidates
from dtwin.physics.dictionary import Dictionary, Entry
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Problem, Term, unweighted

# Smaller effects are not reported: the library's laws are not exact either.
IMMATERIAL = 0.08
_INEXACT = 0.05
# A simpler effect stands in for another one when it loses no more than this of what that explains.
_STANDS_IN = 0.05


def floor_um(problem: Problem) -> float:
    """Return the noise floor; zero where it is not known."""
    return problem.noise.floor_um if problem.noise is not None else 0.0


def material(
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
    floor = (IMMATERIAL * floor_um(problem)) ** 2 * float(obs.mask.sum())
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
