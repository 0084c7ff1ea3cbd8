"""Which of the effects found are more than how far the laws of others are off."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np

from dtwin.physics._dictionary import Dictionary, Entry, dictionary_for
from dtwin.physics.candidates import Candidates
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Problem, Term, unweighted
from dtwin.physics.whitening import from_harmonics, harmonic_numbers
from dtwin.schema import Floats

# Effects, and stand-ins by the label of an effect.
Material = tuple[list[Term], dict[str, list[Term]]]

# Smaller effects are not reported: the library's laws are not exact either.
IMMATERIAL = 0.08
_INEXACT = 0.05
_LEAST = 0.02
# A handful of passes over some dozens of targets tells less.
_LEAST_OF_FEW = 0.05
_LOCAL = 0.1
# The same where all that was found leaves no more than noise.
_EXACT = 0.035
_EXACT_LEAST = 0.015
# So much misfit, of the noise floor, would not be noticed there.
_IN_NOISE = 0.22
# An effect so many times that, of all and beside what is alike or acts where it does, is none of it: the larger the error is
# beside the noise, the smaller the part of it that laws can be off unnoticed.
_UNNOTICED, _UNNOTICED_ALIKE, _UNNOTICED_THERE = 5.0, 7.0, 30.0
# So much of a law that hangs on several shapes another such law may take of it, of the same axis and alike.
_AFTER = 0.15
# As RMS, of what all explain.
_MUCH = 0.1
_MOSTLY = 0.5
# A simpler effect stands in for another one when it loses no more than this of what that explains.
_STANDS_IN = 0.05


def floor_um(problem: Problem) -> float:
    """Return the noise floor; zero where it is not known."""
    return problem.noise.floor_um if problem.noise is not None else 0.0


def weighed(
    terms: Sequence[Term], known: Sequence[Term], library: Candidates, problem: Problem
) -> Callable[[bool], Material]:
    """Return a function of whether laws are exact: it gives the effects that are more than how far the laws of others are off, and their stand-ins.

    Every effect must explain a fiftieth, as RMS, of what all explain, and a twentieth of what those
    explain whose harmonics are its own; one of several shapes a twentieth of all, or where laws are exact a tenth
    of what all explain where it acts, or less where the error is so large beside the noise that laws are shown to be off by
    far less. A stand-in, by the label of the effect, is a simpler effect that loses no more in its place than laws are off.

    ``library``: the candidates for what told the effects; ``problem``: the whole campaign.
    """
    if not terms:
        return lambda _exact: ([], {})
    dictionary = Dictionary(unweighted(library.obs, known), library)
    return partial(_material, dictionary, dictionary.add(terms), floor_um(problem))


def _material(dictionary: Dictionary, entries: list[Entry], noise_um: float, exact: bool) -> Material:
    if not entries:
        return [], {}
    obs = dictionary.candidates.obs
    floor = (IMMATERIAL * noise_um) ** 2 * float(obs.mask.sum())
    whole = dictionary.explained(entries)
    # That laws are exact is shown to within the noise only.
    in_noise = (_IN_NOISE * noise_um) ** 2 * float(obs.mask.sum())
    exact = exact and in_noise < _LEAST**2 * whole
    least_share, inexact, local_share = _LEAST, _INEXACT, _LOCAL
    if exact:
        unnoticed = (in_noise / whole) ** 0.5
        least_share = min(_EXACT_LEAST, _UNNOTICED * unnoticed)
        inexact = min(_EXACT, _UNNOTICED_ALIKE * unnoticed)
        local_share = min(_LOCAL, _UNNOTICED_THERE * unnoticed)
    if obs.there_and_back:
        least_share = _LEAST_OF_FEW
    floor = max(floor, least_share**2 * whole)
    # What has several shapes can take that of any misfit.
    shaped = _INEXACT**2 * whole
    where = _where_it_acts(dictionary, entries, obs) if exact else [np.inf] * len(entries)
    beside = {entry.label: _AFTER**2 * _most_alike(dictionary, entries, entry) for entry in entries}
    least = {
        entry.label: max(
            floor,
            min(shaped, max(in_noise, beside[entry.label], local_share**2 * local))
            if len(entry.term.shape) > 1
            else inexact**2 * alike,
        )
        for entry, alike, local in zip(entries, _alike(dictionary, entries, obs), where, strict=True)
    }
    chosen = _worthwhile(dictionary, entries, least)
    stand_ins = {e.label: _stand_ins(dictionary, chosen, e, least[e.label]) for e in chosen}
    return [entry.term for entry in chosen], stand_ins


def hidden_by_mask(
    everywhere: Sequence[Term], told: Sequence[Term], obs: Observations, known: Sequence[Term], problem: Problem
) -> list[Term]:
    """Return the effects that explain much beside those found, and most of it where the search did not look.

    ``everywhere``: effects that explain the whole campaign best.
    ``told``: effects that were found in a part of it.
    ``known``, ``problem``: what the twin knows, and the whole campaign.
    """
    whole = dictionary_for(unweighted(problem.obs, known), [*told, *everywhere])
    chosen = whole.add(told)
    have = {entry.label for entry in chosen}
    # Near reversals laws are least exact: what keeps its place there may be any of that.
    usual = [term for term in everywhere if not term.instance.effect.another_law(term.shape)]
    rest = [entry for entry in whole.add(usual) if entry.label not in have]
    least = _MUCH**2 * whole.explained([*chosen, *rest])
    out: list[Term] = []
    while rest:
        before = whole.explained(chosen)
        best = max(rest, key=lambda entry: whole.explained([*chosen, entry]))
        if whole.explained([*chosen, best]) - before < least:
            break
        rest.remove(best)
        fitted = whole.fitted([*chosen, best]) - whole.fitted(chosen)
        hidden = fitted.reshape(obs.n_rows, obs.n_bins)
        if _is_hidden(hidden, obs) and not _replaces(best, chosen, whole):
            chosen = [*chosen, best]
            out.append(best.term)
    return out


def _replaces(new: Entry, chosen: list[Entry], dictionary: Dictionary) -> bool:
    """Tell whether one of the effects chosen explains little beside a new one: that stands in its place."""
    after = [*chosen, new]
    both, one = dictionary.explained(after), dictionary.explained(chosen)
    return any(
        both - dictionary.explained([e for e in after if e is not entry])
        < _MOSTLY * (one - dictionary.explained([e for e in chosen if e is not entry]))
        for entry in chosen
    )


def _is_hidden(coefficients: Floats, obs: Observations) -> bool:
    """Tell whether most of what an effect does lies outside of the part that is looked at."""
    um = from_harmonics(coefficients)
    return bool((um**2)[~obs.mask].sum() > _MOSTLY * (um**2).sum())


def _alike(dictionary: Dictionary, entries: list[Entry], obs: Observations) -> list[float]:
    """Return, for each effect, the sum of squares of all effects in so far as their harmonics are its own."""
    number = harmonic_numbers(obs.n_bins)
    fitted = [dictionary.fitted([e]).reshape(obs.n_rows, obs.n_bins) for e in entries]
    power = np.array([np.bincount(number, (f**2).sum(axis=0)) for f in fitted])
    share = np.sqrt(power / np.maximum(power.sum(axis=1, keepdims=True), 1e-300))
    sums = ((share @ share.T) ** 2) @ power.sum(axis=1)
    return np.minimum(sums, dictionary.explained(entries)).tolist()


def _where_it_acts(dictionary: Dictionary, chosen: list[Entry], obs: Observations) -> list[float]:
    """Return, for each effect, the sum of squares of all effects, weighted by where round the path it acts most."""

    def power(entries: list[Entry]) -> Floats:
        um: Floats = from_harmonics(dictionary.fitted(entries).reshape(obs.n_rows, obs.n_bins))
        return np.asarray((um**2).sum(axis=0))

    of_all = power(chosen)
    own = [power([entry]) for entry in chosen]
    return [float(one @ of_all) / max(float(one.max()), 1e-300) for one in own]


def _most_alike(dictionary: Dictionary, entries: list[Entry], entry: Entry) -> float:
    """Return the largest sum of squares of the effects of several shapes that look like one, on its axis."""
    mine = entry.term.instance
    alike = [
        other
        for other in entries
        if other.term.instance.axis == mine.axis
        and other.term.instance.effect.name in mine.effect.confusables
        and len(other.term.shape) > 1
    ]
    return max((dictionary.explained([other]) for other in alike), default=0.0)


def _stand_ins(dictionary: Dictionary, chosen: list[Entry], entry: Entry, least: float) -> list[Term]:
    rest = [e for e in chosen if e is not entry]
    have = {e.label for e in chosen}
    own = _beside(dictionary, rest, entry)
    enough = own - min(least, _STANDS_IN * own)
    gains = zip(dictionary.gains(rest).tolist(), dictionary.entries, strict=True)
    near = [
        (gain, other)
        for gain, other in gains
        if gain > enough
        and other.free < entry.free
        and other.label not in have
        # What explains as much of something else, as of the scatter between runs, is no stand-in.
        and _beside(dictionary, [*rest, other], entry) < _MOSTLY * own
    ]
    # The best shape of each: the last one wins.
    best = {other.label: other.term for _, other in sorted(near, key=lambda pair: pair[0])}
    return list(best.values())


def _beside(dictionary: Dictionary, others: list[Entry], entry: Entry) -> float:
    """Return what an effect explains beside others."""
    return dictionary.explained([*others, entry]) - dictionary.explained(others)


def _worthwhile(dictionary: Dictionary, remaining: list[Entry], least: Mapping[str, float]) -> list[Entry]:
    """Return the best of the effects found where each must explain so much: drop, add and exchange."""

    def worth(entries: list[Entry]) -> float:
        return dictionary.explained(entries) - sum(least[e.label] for e in entries)

    chosen, most = remaining, worth(remaining)
    while True:
        rest = [e for e in remaining if e not in chosen]
        fewer = [chosen[:i] + chosen[i + 1 :] for i in range(len(chosen))]
        moves = [*fewer, *([*entries, e] for entries in [chosen, *fewer] for e in rest)]
        best = max(moves, key=worth, default=chosen)
        if worth(best) <= most:
            return chosen
        chosen, most = best, worth(best)
