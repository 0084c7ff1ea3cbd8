"""Which set of effects leaves least for what it costs, in one whitening."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dtwin.physics._dictionary import PITCH, Dictionary, Entry, is_periodic
from dtwin.physics._learned_places import LEARNED
from dtwin.physics._plausible import at_its_end
from dtwin.physics._shapes import refined
from dtwin.physics.candidates import Candidates
from dtwin.physics.problem import Problem, Term

# An effect must explain this share of what is left beyond noise, which may be misfit.
_SHARE_OF_REST = 0.1
# More left than this many times the noise is misfit.
MISFIT = 1.05
# And less than this many times hardly more than noise.
_HARDLY_MORE = 1.25
_PASSES = 8
_MOVES = 40
_SETTLED = 1e-3
# A law without a name is one of hundreds, and can do what two effects do.
_NAMELESS = 3.0
# Pitches of one axis that differ by more are of two screws.
_SAME_PITCH = 1.02
# Columns from which on an effect may stand for several simpler ones.
_MANY = 3
# Between the shapes of the grid one effect may explain more than so much of what two do.
_NEAR = 0.7
# One mode may leave more than two by this share of what they explain.
_CLEARLY = 0.01
# Of the targets of an axis: more numbers than this share would draw any curve through them, of the same both ways or not.
_CARRIED = 2.0 / 3.0


def repeat_variance(problem: Problem) -> float:
    """Return the variance of a whitened coefficient, by what repeats disagree by."""
    assert problem.noise is not None
    return float(np.nanmean(problem.noise.variance))


class Hunt:
    """Adds, drops and replaces effects until nothing lowers the cost.

    ``problem``: whitened campaign with what is known.
    ``dictionary``: the library beside it.
    ``level``: variance of a whitened coefficient; by default that of the repeats.
    """

    def __init__(self, problem: Problem, dictionary: Dictionary, level: float | None = None) -> None:
        level = repeat_variance(problem) if level is None else level
        self.dictionary = dictionary
        runs = int(problem.obs.run_of.max()) + 1
        # Schwarz's criterion over runs for every number, and the choice among all effects.
        self._per_number = level * float(np.log(runs))
        self._per_effect = 2.0 * level * float(np.log(max(2, len(dictionary.candidates.instances))))
        self._noise = level * float(problem.obs.mask.sum())
        self._most = _CARRIED * problem.obs.n_bins if problem.obs.there_and_back else np.inf
        # Of each entry of the dictionary.
        self._prices, self._widths, self._parities = np.empty(0), np.empty(0), np.empty(0, dtype=str)
        self._impossible: set[str] = set()
        # Sets of labels of which no two effects are one.
        self._apart: set[frozenset[str]] = set()

    def left(self, chosen: Sequence[Entry]) -> float:
        """Return the sum of squares that a set leaves."""
        return self.dictionary.total - self.dictionary.explained(chosen)

    def leaves_noise(self, chosen: Sequence[Entry]) -> bool:
        """Tell whether a set leaves hardly more than repeats disagree by."""
        return self.left(chosen) < _HARDLY_MORE * self._noise

    def run(self, chosen: list[Entry]) -> list[Entry]:
        """Return the best set that is reached from one."""
        start, best, least = chosen, chosen, np.inf
        settled: set[str] = set()
        for _ in range(_PASSES):
            chosen = self._improved(self._grown(chosen))
            chosen = self._improved(self._refined(chosen))
            labels = {entry.label for entry in chosen}
            if labels != settled:
                other = self._one_for_two(self._simplified(self._two_replaced(chosen)))
                other = self._with_one_mode(self._with_one_screw(other))
                if other is chosen:
                    settled = labels
                else:
                    chosen = self._improved(self._refined(other))
            cost = self._cost(chosen)
            if cost >= least - self._per_effect:
                break
            best, least = chosen, cost
        best = self.without_bends(best)
        if impossible := {entry.label for entry in best if self._is_impossible(entry, best)}:
            return self._without(impossible, start, best)
        return best

    def _without(self, labels: set[str], start: Sequence[Entry], best: list[Entry]) -> list[Entry]:
        """Return the best set without some effects, reached from the best with them, or from the start where that leaves clearly more."""
        self._impossible |= labels
        most = (1.0 + _CLEARLY) * self.left(best)
        other = self.run([entry for entry in best if entry.label not in self._impossible])
        if self.left(other) > most:
            again = self.run([entry for entry in start if entry.label not in self._impossible])
            other = min(other, again, key=self._cost)
        # On one circle a bend is the oval of many effects, and an oval that is missed may cost more than a name.
        return best if self._on_one_circle and self.left(other) > most else other

    def _is_impossible(self, entry: Entry, chosen: Sequence[Entry]) -> bool:
        """Tell whether a set needs a number below zero that cannot be there, as a compliance, or along an axis a shape at its end."""
        if self.dictionary.problem.obs.there_and_back and at_its_end(entry.term):
            return True
        parameters = entry.term.instance.effect.parameters
        if len(parameters) != entry.width:
            return False
        values, own = self.dictionary.coefficients(chosen, entry)
        positive = np.array([parameter.positive for parameter in parameters])
        return bool((positive & (values < 0.0) & (own > self._per_effect)).any())

    def _price(self, entry: Entry) -> float:
        chosen_from = _NAMELESS if entry.term.instance.effect.source == LEARNED else 1.0
        return self._per_number * entry.free + chosen_from * self._per_effect

    def _cost(self, chosen: Sequence[Entry]) -> float:
        return self.left(chosen) + sum(self._price(entry) for entry in chosen)

    def _is_worth(self, gain: float, left: float, entry: Entry) -> bool:
        return gain > max(self._price(entry), _SHARE_OF_REST * (left - self._noise))

    def _best(self, chosen: Sequence[Entry], fewer: float = np.inf) -> tuple[Entry, float] | None:
        """Return the entry of fewer numbers than so many that would lower the cost most beside a set, and its gain."""
        entries = self.dictionary.entries
        if new := entries[len(self._prices) :]:
            self._prices = np.append(self._prices, [self._price(entry) for entry in new])
            self._widths = np.append(self._widths, [entry.width for entry in new])
            self._parities = np.append(self._parities, [entry.parity for entry in new])
        gains = self.dictionary.gains(chosen)
        worth = gains - self._prices
        worth[self.dictionary.numbers_of({entry.label for entry in chosen} | self._impossible)] = -np.inf
        worth[self._too_many(chosen)] = -np.inf
        if np.isfinite(fewer):
            worth[[entry.free >= fewer for entry in entries]] = -np.inf
        if not np.isfinite(worth).any():
            return None
        number = len(worth) - 1 - int(np.argmax(worth[::-1]))
        return entries[number], float(gains[number])

    def _too_many(self, chosen: Sequence[Entry]) -> NDArray[np.bool_]:
        """Tell of each entry whether it has, with a set, more columns of one parity than targets carry."""
        numbers = self._widths.copy()
        for entry in chosen:
            numbers[self._parities == entry.parity] += entry.width
        return numbers > self._most

    def _grown(self, chosen: list[Entry]) -> list[Entry]:
        while True:
            self.dictionary.add_pitches(chosen)
            best = self._best(chosen)
            if best is None or not self._is_worth(best[1], self.left(chosen) - best[1], best[0]):
                return chosen
            chosen = [*chosen, best[0]]

    def _improved(self, chosen: list[Entry]) -> list[Entry]:
        for _ in range(_MOVES):
            changed = self._moved(chosen)
            if changed is None:
                break
            chosen = changed
        return chosen

    def _moved(self, chosen: list[Entry]) -> list[Entry] | None:
        """Return the set without its weakest effect, or with the best replacement of one."""
        left, cost = self.left(chosen), self._cost(chosen)
        best: tuple[float, list[Entry]] | None = None
        weakest: tuple[float, list[Entry]] | None = None
        for number, entry in enumerate(chosen):
            rest = chosen[:number] + chosen[number + 1 :]
            own = self.left(rest) - left
            if not self._is_worth(own, left, entry):
                weakest = min(weakest or (np.inf, rest), (own, rest), key=lambda pair: pair[0])
            better = self._best(rest)
            if (
                better is None
                or better[0] is entry
                or (better[0].label == entry.label and not is_periodic(entry.term.instance))
            ):
                continue
            other = [*rest, better[0]]
            changed = self._cost(other)
            if changed < cost - 1e-9 * self.dictionary.total and (best is None or changed < best[0]):
                best = changed, other
        if weakest is not None:
            return weakest[1]
        return None if best is None else best[1]

    def _two_replaced(self, chosen: list[Entry]) -> list[Entry]:
        """Return the set with two effects replaced by one or two others, where that is cheaper."""
        best, least = chosen, self._cost(chosen) - _SETTLED * self._noise / len(chosen or [0])
        for i in range(len(chosen)):
            for j in range(i):
                rest = [entry for k, entry in enumerate(chosen) if k not in (i, j)]
                for _ in range(2):
                    next_best = self._best(rest)
                    if next_best is None:
                        break
                    rest = [*rest, next_best[0]]
                    cost = self._cost(rest)
                    if cost < least:
                        best, least = rest, cost
        return best

    def _simplified(self, chosen: list[Entry]) -> list[Entry]:
        """Return the set with general effects replaced by simpler ones, where that is cheaper or leaves noise only.

        Guideways of any shape take up what axes do that lean in three planes, and a pitch error beside them what scales and
        squareness do: none of them alone can be replaced. All are tried together, then those of each name.
        """
        best = chosen
        general = [entry for entry in chosen if _is_general(entry)]
        names = dict.fromkeys(entry.term.instance.effect.name for entry in general)
        by_name = [[e for e in general if e.term.instance.effect.name == name] for name in names]
        for own in [general, *by_name] if len(by_name) > 1 else by_name:
            rest = [entry for entry in chosen if entry not in own]
            for _ in range(len(own) + 2):
                simpler = self._best(rest, min(entry.free for entry in own))
                if simpler is None:
                    break
                rest = [*rest, simpler[0]]
                if self.left(rest) < MISFIT * self._noise or self._cost(rest) < self._cost(best):
                    # What was there for what the effect misses is no more needed.
                    best = min(best, self._improved(rest), key=self._cost)
                    break
        return best

    def _one_for_two(self, chosen: list[Entry]) -> list[Entry]:
        """Return the set with one effect, its shape fitted, in place of any two of an axis, where that is cheaper.

        Of effects that look alike only: a step and a spike are friction that the drive overcomes in its own time, which no shape of the grid need be.
        """
        labels = frozenset(entry.label for entry in chosen)
        if not self.dictionary.problem.obs.several_speeds or labels in self._apart:
            return chosen
        for first, second in itertools.combinations(chosen, 2):
            axis, alike = first.term.instance.axis, sorted(_alike(first) & _alike(second))
            if axis != second.term.instance.axis or not alike:
                continue
            rest = [entry for entry in chosen if entry not in (first, second)]
            explained = self.left(rest) - self.left(chosen)
            for name in alike:
                gains = self.dictionary.gains(rest)
                wanted = {f"{name} {axis}"} - self._impossible
                numbers = [n for n in self.dictionary.numbers_of(wanted) if gains[n] > _NEAR * explained]
                start = self.dictionary.entries[max(numbers, key=gains.__getitem__)] if numbers else None
                if start is not None and start.term.shape:
                    beside = self.dictionary.campaign.given(entry.term for entry in rest)
                    alone = refined(beside, [start.term], self._per_number, bounded=True)
                    one = [*rest, *self.dictionary.add(alone)]
                    if self._cost(one) < self._cost(chosen):
                        return self._one_for_two(one)
        self._apart.add(labels)
        return chosen

    def _with_one_screw(self, chosen: list[Entry]) -> list[Entry]:
        """Return the set with the pitch of one effect for all of its axis that repeat in a pitch, where that is cheaper.

        A pitch that is wrong fits what others miss, and by itself none changes to that of the screw.
        """
        best = chosen
        for axis in dict.fromkeys(entry.term.instance.axis for entry in chosen if is_periodic(entry.term.instance)):
            on_it = [e for e in chosen if is_periodic(e.term.instance) and e.term.instance.axis == axis]
            pitches = [entry.term.shape[PITCH] for entry in on_it]
            if max(pitches) < _SAME_PITCH * min(pitches):
                continue
            rest = [entry for entry in chosen if entry not in on_it]
            for pitch in pitches:
                turned = [replace(e.term, shape=dict(e.term.shape) | {PITCH: pitch}) for e in on_it]
                other = self._improved(self._grown(self._refined([*rest, *self.dictionary.add(turned)])))
                best = min(best, other, key=self._cost)
        return best

    def _with_one_mode(self, chosen: list[Entry]) -> list[Entry]:
        """Return the set with one mode of an axis in place of one that bends and one that rings, unless it leaves clearly more.

        On one circle a bend is the oval of many effects.
        """
        if not self._on_one_circle:
            for whole in chosen:
                label = _part_of(whole.term)
                for rings in (entry for entry in chosen if entry.label == label):
                    one = self._instead(chosen, whole, replace(whole.term, shape=rings.term.shape))
                    if one is not chosen:
                        return one
        return chosen

    def without_bends(self, chosen: list[Entry]) -> list[Entry]:
        """Return the set with what only rings in place of each mode whose bend explains next to nothing."""
        if not self._on_one_circle:
            for whole in chosen:
                for instance in self.dictionary.candidates.instances:
                    if instance.label == _part_of(whole.term):
                        chosen = self._instead(chosen, whole, Term(instance, whole.term.shape))
        return chosen

    def _instead(self, chosen: list[Entry], whole: Entry, term: Term) -> list[Entry]:
        """Return the set with a term in place of a mode and of what rings beside it, or the set itself if that leaves clearly more."""
        rest = [entry for entry in chosen if entry.label not in (whole.label, _part_of(whole.term))]
        beside = self.dictionary.campaign.given(entry.term for entry in rest)
        one = [*rest, *self.dictionary.add(refined(beside, [term], self._per_number, bounded=True))]
        left = self.left(chosen)
        without = rest if term.instance is whole.term.instance else [entry for entry in chosen if entry is not whole]
        return one if self.left(one) < left + _CLEARLY * (self.left(without) - left) else chosen

    @property
    def _on_one_circle(self) -> bool:
        return len({(c.radius_mm, c.feed_mm_min) for c in self.dictionary.problem.obs.conditions}) == 1

    def _refined(self, chosen: list[Entry]) -> list[Entry]:
        terms = refined(self.dictionary.campaign, [e.term for e in chosen], self._per_number, bounded=True)
        changed = [t for t, e in zip(terms, chosen, strict=True) if t is not e.term]
        new = {entry.label: entry for entry in self.dictionary.add(changed)}
        return [new.get(entry.label, entry) for entry in chosen]


def without_bends(terms: list[Term], problem: Problem, candidates: Candidates) -> list[Term]:
    """Return effects with what only rings in place of each mode whose bend explains next to nothing beside the others."""
    labels = {term.label for term in terms}
    rings = {_part_of(term) for term in terms if term.instance.effect.at_one_speed}
    if not rings:
        return terms
    few = candidates.only([i for i in candidates.instances if i.label in labels | rings])
    hunt = Hunt(problem, Dictionary(problem, few))
    return [entry.term for entry in hunt.without_bends(hunt.dictionary.add(terms))]


def _part_of(term: Term) -> str:
    """Return the label of what an effect is at one speed, or else of nothing."""
    return f"{term.instance.effect.at_one_speed} {term.instance.axis}"


def _alike(entry: Entry) -> set[str]:
    """Return the names of an effect and of those that look like it."""
    effect = entry.term.instance.effect
    return {effect.name, *effect.confusables}


def _is_general(entry: Entry) -> bool:
    """Tell whether an effect may stand for several simpler ones."""
    return entry.width >= _MANY or bool(entry.term.instance.effect.special_cases)
