"""What cannot be told from the effects that were found."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from dtwin.physics._best_shapes import in_best_shapes
from dtwin.physics._condensed import Condensed
from dtwin.physics._dictionary import Dictionary, Entry, is_periodic
from dtwin.physics._logged_heat import as_good_as_logged, logged_instead
from dtwin.physics._score import NoiseLevel, misfit, noise_level, score_test
from dtwin.physics._shapes import refined
from dtwin.physics.candidates import Candidate, Candidates, probes
from dtwin.physics.cross_validation import left_out_gain, left_out_places
from dtwin.physics.problem import Problem, Term, least_visible
from dtwin.schema import Floats

_GROUP_GAIN = 0.5
# Between the shapes of the grid an effect may explain more.
_NEAR = 0.3
_GROUP_P = 0.05
# The shape of the top effect was chosen among many: what has fewer numbers is not ruled out so soon.
_SIMPLER_P = 0.01
AFTER_A_REVERSAL = {"reversal_spike", "reversal_ringing", "structural_resonance"}
"""At one speed what follows a reversal looks alike, whether friction, a mode or the servo makes it."""
_AS_GOOD = 0.9
# Sizes that machines have must leave less than this share of what an effect would explain.
_IMPOSSIBLE = 0.1
# So much, where laws hold, of what the other explains is no less.
_NO_LESS = 0.99
# So much of the size of another is as large.
_AS_LARGE = 0.5
# Share of what is left at a target left out that a curve of any shape foretells; waves that targets do not follow give it less.
_FORETOLD_OF_CURVE = 0.3


@dataclass(frozen=True, eq=False)
class Found:
    """One effect that was found, with its rivals.

    ``top``: the effect, tested against what all the others leave.
    ``group``: it, and what these runs cannot tell from it, best first.
    ``absorbed``: those of the group that cannot be seen beside the effect: they may be there as well.
    ``together``: those that are rivals only beside others, by label, with these.
    ``problem``: the campaign with all the other effects that were found.
    ``candidates``: the library where it was tested.
    ``gain``: gain on conditions that were left out.
    ``size_um``: RMS of what it explains beside all the others.
    ``fitted_um``, (rows, n): what it does.
    """

    top: Candidate
    group: tuple[Candidate, ...]
    absorbed: frozenset[str]
    together: Mapping[str, Sequence[Term]]
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


def described(
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
    not be ruled out there either, unless both are what follows a reversal: there laws are least exact.
    """
    out = []
    level = level_beside(candidates.given(problem, terms))
    rough = NoiseLevel(misfit=misfit(everywhere.given(whole, terms)))
    dictionary = Dictionary(problem, candidates)
    chosen = {entry.label: entry for entry in dictionary.add(terms)}
    for term in terms:
        others = [t for t in terms if t is not term]
        given = candidates.given(problem, others)
        top = candidates.tested_term(given, term, level)
        if top is None:
            continue
        rest = [entry for label, entry in chosen.items() if label != term.label]
        few = dictionary.campaign.given(others)
        rivals, _ = in_best_shapes(dictionary, rest, given, level, but=_far(dictionary, chosen, term))
        bare = everywhere.given(plain, others)
        group, absorbed = _group(given, few, candidates, level, top, rivals, whole is not problem)
        # What rings at a reversal may be all that is significant of a mode, and its oval all that is large.
        least_um = _AS_LARGE * everywhere.size_um(bare, term)
        group = group[:1] + tuple(
            c for c in group[1:] if not _is_like(top, c) or everywhere.size_um(bare, c.term) >= least_um
        )
        if whole is not problem:
            beside = everywhere.given(whole, others)
            group = group[:1] + tuple(
                c
                for c in group[1:]
                if c.term.label in absorbed
                or (_is_like(top, c) and c.score.gain > _NO_LESS * top.score.gain)
                or as_good_as_logged(top, c)
                or _adds_nothing(beside, top, c, everywhere, rough)
            )
        have = {c.term.label for c in group}
        simpler = [t for t in stand_ins.get(term.label, ()) if t.label not in have]
        others_tested = [candidates.tested_term(given, t, level) for t in simpler]
        group += tuple(c for c in others_tested if c is not None)
        sets = _sets(problem, candidates, terms, term, rivals, group, level)
        group += sets
        two = _two_instead(given, few, candidates, top, rivals, group, level)
        group += two or _beside_a_part(given, candidates, top, group, level)
        parts = _parts_instead(given, candidates, top, group, level)
        group += parts
        logged, scale = logged_instead(given, candidates, top, group, level)
        group += logged
        beside_top = candidates.given(given, [term])
        group = tuple(c for c in group if c in sets or _is_possible(given, candidates, c, beside_top)) or group
        top, term = group[0], group[0].term
        absorbed -= {term.label}
        names = {c.term.instance.effect.name for c in group}
        group = group[:1] + tuple(c for c in group[1:] if not names & set(c.term.instance.effect.special_cases))
        gain = left_out_gain(given, candidates.whitened(given, term))
        free = bool(term.instance.effect.special_cases) or is_periodic(term.instance)
        any_curve = plain.obs.there_and_back and free
        if term.instance.effect.stated or any_curve:
            # A curve along the axis may be drawn through its targets: what is said to be there must foretell them.
            places = left_out_places(bare, everywhere.whitened(bare, term))
            gain = min(gain, places - _FORETOLD_OF_CURVE * float(any_curve))
        visible = everywhere.visible(bare, term)
        fitted = (visible @ (visible.T @ bare.residual.ravel())).reshape(bare.residual.shape)
        size_um = everywhere.size_um(bare, term)
        together = {
            c.term.label: [o.term for o in parts if o is not c]
            if c in parts
            else [o.term for o in group if o.term.instance.effect is c.term.instance.effect and o is not c]
            for c in (*sets, *parts)
        } | {c.term.label: scale for c in logged}
        out.append(Found(top, group, absorbed, together, given, candidates, level, gain, size_um, fitted))
    return tuple(sorted(out, key=lambda f: -f.size_um))


def _is_possible(problem: Problem, candidates: Candidates, candidate: Candidate, beside_top: Problem) -> bool:
    """Tell whether an effect in place of another would be of a size that machines have.

    At a low feed what hardly accelerates would need a machine softer than any to be an oval of some micrometres. And of
    which sign: unless it cannot be seen beside the other, where it may be as well and take a part of that away.
    """
    columns = candidates.whitened(problem, candidate.term)
    turned, along = np.linalg.qr(columns - problem.basis @ (problem.basis.T @ columns))
    wanted = turned.T @ problem.residual.ravel()
    parameters = candidate.term.instance.effect.parameters
    # What is stated in micrometres is what the runs show; only a coefficient can be one of no machine.
    signed = any(p.positive for p in parameters) and candidates.visible(beside_top, candidate.term).shape[1] > 0
    largest = np.array([np.inf if p.unit == "um" else p.largest for p in parameters])
    least = np.where([p.positive and signed for p in parameters], 0.0, -largest)
    # Where columns are nearly alike sizes are large that need not be.
    left = 2.0 * scipy.optimize.lsq_linear(along, wanted, (least, largest)).cost
    return left < _IMPOSSIBLE * float(wanted @ wanted)


def level_beside(problem: Problem) -> NoiseLevel:
    """Return the noise level, and what repeats agree on besides, of a campaign with all that was found.

    It serves the test of each effect beside the others, too: repeats differ by what none of them does.
    """
    return replace(noise_level(problem, probes(problem)), misfit=misfit(problem))


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
        or (most[entry.label] < _NEAR * own and entry.term.instance.effect.name not in term.instance.effect.confusables)
    }


def _group(
    problem: Problem,
    few: Condensed,
    candidates: Candidates,
    level: NoiseLevel,
    top: Candidate,
    rivals: Sequence[Candidate],
    in_part: bool,
) -> tuple[tuple[Candidate, ...], frozenset[str]]:
    """Return what cannot be told from the top effect, and the labels of what cannot be seen beside it.

    What leaves it nothing significant to explain, a 95 % confidence set. Where only a part of the
    data is looked at, also what is simpler, explains half as much alone and nothing beside it: how
    much of the two is there is not known.
    """
    group, hidden = [top], set()
    beside = problem.extended(top.visible, candidates.whitened(problem, top.term))
    for rival in sorted(rivals, key=lambda c: -c.score.gain):
        if rival.score.gain < _NEAR * top.score.gain:
            continue
        other = refined_candidate(problem, few, candidates, rival, level)
        if other.score.gain < _GROUP_GAIN * top.score.gain:
            continue
        plainer = in_part and candidates.numbers(other.term) < candidates.numbers(top.term)
        if plainer and not candidates.visible(beside, other.term).shape[1]:
            hidden.add(other.term.label)
        elif not _as_good(problem, top, other) and not _adds_nothing(
            problem, top, other, candidates, level, other.visible
        ):
            continue
        group.append(other)
    return tuple(group), frozenset(hidden)


def _as_good(problem: Problem, top: Candidate, other: Candidate) -> bool:
    """Tell whether only another speed would tell a rival from the top effect, for laws are not exact.

    Of two that are known to look alike at one speed, the one whose law is nearer need not be the cause.
    """
    enough = other.score.gain > _AS_GOOD * top.score.gain
    return (_is_like(top, other) and enough and not problem.obs.several_speeds) or as_good_as_logged(top, other)


def _is_like(top: Candidate, other: Candidate) -> bool:
    """Tell whether two effects are what follows a reversal of one axis."""
    first, second = top.term.instance, other.term.instance
    return {first.effect.name, second.effect.name} <= AFTER_A_REVERSAL and first.axis == second.axis


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
    given = candidates.given(problem, [t for t in terms if t not in own])
    have = {c.term.label for c in group}
    out: list[Candidate] = []
    for other in term.instance.effect.confusables:
        like = [c for c in rivals if c.term.instance.effect.name == other]
        numbers = sum(candidates.numbers(c.term) for c in like)
        # What needs more numbers is no plainer explanation.
        if len(like) + len(own) < 3 or not 0 < numbers <= sum(map(candidates.numbers, own)):
            continue
        with_them = candidates.given(given, [c.term for c in like])
        whitened = np.concatenate([candidates.whitened(given, t) for t in own], axis=1)
        left, _ = with_them.visible(whitened, least=least_visible(term))
        within = term.instance.effect.within_condition
        if not left.shape[1] or (
            score_test(with_them, left, with_them.residual, level, within=within).p_value > _GROUP_P
        ):
            out += [c for c in like if c.term.label not in have]
    return tuple(out)


def _two_instead(
    problem: Problem,
    few: Condensed,
    candidates: Candidates,
    top: Candidate,
    rivals: Sequence[Candidate],
    group: Sequence[Candidate],
    level: NoiseLevel,
) -> tuple[Candidate, ...]:
    """Return two simpler effects that at one speed are together what an effect is: a mode is an oval and what rings."""
    if problem.obs.several_speeds or any(not _is_like(top, c) for c in group):
        return ()
    numbers = candidates.numbers(top.term)
    have = {c.term.label for c in group}
    alike = [c for c in rivals if _is_like(top, c) and c.term.label != top.term.label]
    most = [c for c in rivals if c.score.gain > _GROUP_GAIN * top.score.gain and c not in alike]
    for first in sorted(most, key=lambda c: -c.score.gain):
        given = candidates.given(problem, [first.term])
        for second in alike:
            if candidates.numbers(first.term) + candidates.numbers(second.term) > numbers:
                continue
            beside = refined(few.given([first.term]), [second.term], bounded=True)
            if _is_nothing(candidates.given(given, beside), candidates, top, level, _SIMPLER_P):
                return tuple(c for c in (first, second) if c.term.label not in have)
    return ()


def _parts_instead(
    problem: Problem, candidates: Candidates, top: Candidate, group: Sequence[Candidate], level: NoiseLevel
) -> tuple[Candidate, ...]:
    """Return two simple effects that only together are what one is to a tone: far below a mode or the bandwidth of a loop, these are inertia and a delay."""
    if problem.obs.grid.in_plane:
        return ()
    have = {c.term.label for c in group}
    alike = [
        Term(i)
        for i in candidates.instances
        if i.effect.name in top.term.instance.effect.confusables and not i.effect.shapes and i.label not in have
    ]
    for pair in itertools.combinations(alike, 2):
        both = [candidates.tested_term(problem, term, level) for term in pair]
        parts = tuple(c for c in both if c is not None)
        if (
            len(parts) == len(pair)
            and sum(map(candidates.numbers, pair)) < candidates.numbers(top.term)
            and _is_nothing(candidates.given(problem, pair), candidates, top, level, _SIMPLER_P)
        ):
            return parts
    return ()


def _beside_a_part(
    problem: Problem, candidates: Candidates, top: Candidate, group: Sequence[Candidate], level: NoiseLevel
) -> tuple[Candidate, ...]:
    """Return each effect that at one speed is, together with a part of an effect, exactly that effect.

    The oval of a mode is that of a scale; what rings may then be another mode, or how far the law of a spike is off.
    Nothing where what follows the reversals is enough without an oval, or the group has an oval.
    """
    effect, axis = top.term.instance.effect, top.term.instance.axis
    if problem.obs.several_speeds or not effect.at_one_speed or any(_is_like(top, c) for c in group[1:]):
        return ()
    label = f"{effect.at_one_speed} {axis}"
    part = [Term(i, top.term.shape) for i in candidates.instances if i.label == label]
    given = candidates.given(problem, part)
    if not candidates.visible(given, top.term).shape[1]:
        return ()
    simple = [Term(instance, {}) for instance in candidates.instances if not instance.effect.shapes]
    ovals = [
        term
        for term in simple
        if candidates.visible(given, term).shape[1]
        and not candidates.visible(candidates.given(given, [term]), top.term).shape[1]
    ]
    if {term.label for term in ovals} & {c.term.label for c in group}:
        return ()
    tested = (candidates.tested_term(problem, term, level) for term in ovals)
    return tuple(candidate for candidate in tested if candidate is not None)


def refined_candidate(
    problem: Problem, few: Condensed, candidates: Candidates, candidate: Candidate, level: NoiseLevel
) -> Candidate:
    """Return a candidate in the shape, within its grid, that leaves least; ``few``: the problem, condensed."""
    (term,) = refined(few, [candidate.term], bounded=True)
    if term is candidate.term:
        return candidate
    return candidates.at(problem, candidate, term, level)


def _adds_nothing(
    problem: Problem,
    top: Candidate,
    other: Candidate,
    candidates: Candidates,
    level: NoiseLevel,
    visible: Floats | None = None,
) -> bool:
    """Tell whether an effect has nothing significant left beside another one; ``visible``: of that one, where it was tested in this problem."""
    visible = candidates.visible(problem, other.term) if visible is None else visible
    given = problem.extended(visible, candidates.whitened(problem, other.term))
    simpler = candidates.numbers(other.term) < candidates.numbers(top.term)
    return _is_nothing(given, candidates, top, level, _SIMPLER_P if simpler else _GROUP_P)


def _is_nothing(given: Problem, candidates: Candidates, top: Candidate, level: NoiseLevel, least_p: float) -> bool:
    """Tell whether an effect has nothing significant left to explain."""
    left = candidates.tested_term(given, top.term, level)
    return left is None or left.score.p_value > least_p
