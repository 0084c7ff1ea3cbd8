"""Which of the effects found are doubted: their laws are broken, or they hang on what is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from dtwin.physics import localise
from dtwin.physics._dictionary import PITCH, is_periodic
from dtwin.physics._grading import survivors, variables
from dtwin.physics._laws import LawTest
from dtwin.physics._plausible import at_its_end
from dtwin.physics._rivals import Found
from dtwin.physics._search import Search
from dtwin.physics._trust import alike_in_harmonics, does_um, sum_um
from dtwin.physics.candidates import Candidates
from dtwin.physics.observations import SETUP_COLUMNS, Observations
from dtwin.physics.problem import Problem

# At this p-value what is left is certain.
LACK_OF_FIT = 0.003
# A smaller share of everything, as RMS, is small.
SPOKEN_OF = 0.1
# An exponent that is known no better tells nothing of a law.
_VAGUE = 0.3
_DWARFED = 0.4
# So much of what moves with a channel its law may leave there, along an axis.
_LATE = 0.2
# So much of what is left of conditions left out an effect foretells that is no part of something larger.
_FORETOLD = 0.4
# The shape of a wave of any length.
_WAVE = "wave_mm"
# What has less of its size left without what is withdrawn makes up for that.
_ALONE = 0.5
# A curve of so many numbers that is less than so many times what is left may follow that.
_MANY, _MUCH_LARGER = 3, 3.0
# Amplitudes and shapes of an answer to tones.
_MANY_IN_TONES, _LARGER = 5, 1.2
# A curve is no part of what laws of one place leave, if it is so much of what they explain.
_OF_PLACES = 0.17
# What changes with the feed at this p-value, by however little.
_MOVES = 0.005
# More of a curve than this in a fifth of the travel is one place and no screw.
_LOCAL, _STRETCH = 0.6, 5
# What alone makes so many times what it explains beside the others is taken away by them.
_TAKEN_AWAY = 1.4
_SAME_LENGTH = 0.01

# Tests of the laws of every effect found and of its rivals, by label.
Tests = Mapping[str, Mapping[str, Sequence[LawTest]]]


def doubted(search: Search, late_um: float, tests: Tests) -> list[Found]:
    """Return the effects whose laws are broken, or that foretell nothing.

    ``late_um``: what still moves with a channel of the library's own, RMS.
    """
    may_leave = _LATE if search.plain.obs.there_and_back else 0.0
    return [
        f
        for f in search.found
        if not survivors(f, tests[f.label])
        or at_its_end(f.top.term)
        or _hangs_untested(f, tests[f.label][f.label], search)
        or f.gain <= 0.0
        or f.size_um <= 0.0
        or _is_local(f, search.plain.obs)
        or (late_um > may_leave * f.size_um and f.top.term.instance.effect.within_condition)
        or _is_weak(f, tests[f.label][f.label], search)
    ]


def beside_places(search: Search, first: Search) -> list[Found]:
    """Return the curves of many numbers that are small beside laws of one place: these may have another form.

    ``first``: the search without the laws.
    """
    whole_um, left_um = first.systematic_um[0], search.systematic_um[0]
    least_um = _OF_PLACES * max(0.0, whole_um**2 - left_um**2) ** 0.5
    return [
        f
        for f in search.found
        if f.candidates.numbers(f.top.term) > _MANY
        and not is_periodic(f.top.term.instance)
        and not f.top.term.instance.effect.within_condition
        and f.size_um < least_um
    ]


def is_dwarfed(effect: Found, search: Search) -> bool:
    """Tell whether what is certainly left is so much larger that an effect may be a part of it."""
    certain = search.lack_of_fit[-1] <= LACK_OF_FIT
    return certain and effect.size_um < _DWARFED * search.systematic_um[-1]


def follows_unknown(effect: Found, tests: Tests, search: Search) -> bool:
    """Tell whether an effect of the place on circles, or any in tones, may be drawn through something unknown that is left.

    A smooth curve of many numbers follows anything. What is the same at every feed, by its law, and is not quite, is the mean of
    something that is not. In tones it is an answer of many numbers, no simpler one in its group, that is not larger than what is left.
    """
    first_um, left_um = search.systematic_um
    certain = search.lack_of_fit[-1] <= LACK_OF_FIT and left_um > SPOKEN_OF * first_um
    term, obs = effect.top.term, search.plain.obs
    if not certain or obs.there_and_back:
        return False
    numbers = effect.candidates.numbers(term)
    if not obs.grid.in_plane:
        alone = len(survivors(effect, tests[effect.label])) == 1
        return alone and numbers >= _MANY_IN_TONES and effect.size_um < _LARGER * left_um
    if term.instance.effect.law.feed != 0.0:
        return False
    many = numbers - len(term.instance.effect.shapes) >= _MANY
    own = tests[effect.label][effect.label]
    moves = any(t.variable == "feed" and t.p_value < _MOVES for t in own)
    return (many or moves) and effect.size_um < _MUCH_LARGER * left_um


def without_dwarfed(kept: Sequence[Found], bare: Problem, candidates: Candidates) -> list[Found]:
    """Return the effects without those of the place that are small beside what is not resolved, and foretell little of it.

    A cable that pulls by the place is a curve of which a small straightness, pitch error or play takes its part. What has other
    harmonics is no part of it. A wave of any length is drawn through all that comes back at the same place, and foretells it.

    ``bare``: the campaign without weights, with what is known.
    """
    obs = bare.obs
    left = localise.in_angle(candidates.given(bare, [f.top.term for f in kept]))
    left_um = localise.systematic_rms_um(obs, left)
    means = localise.condition_means(obs, left)

    def is_dwarfed(f: Found) -> bool:
        free = _WAVE in f.top.term.shape
        if f.top.term.instance.effect.law.feed != 0.0 or (f.gain >= _FORETOLD and not free):
            return False
        return f.size_um < (1.0 if free else _DWARFED) * left_um * alike_in_harmonics(f, means, obs)

    return [f for f in kept if not is_dwarfed(f)]


def hidden_by(doubts: Sequence[Found], search: Search, tests: Tests) -> list[Found]:
    """Return the effects smaller than what is doubted whose own laws are not confirmed.

    What is not what it seems leaves something of itself, which smaller effects take.
    """
    doubted_um = localise.systematic_rms_um(search.plain.obs, sum_um(doubts, search.plain.obs))
    return [
        f
        for f in search.found
        if f not in doubts
        and f.size_um < doubted_um
        and not all(t.confirmed for t in _over_conditions(tests[f.label][f.label]))
    ]


def standing_alone(kept: list[Found], search: Search, bare: Problem, candidates: Candidates) -> list[Found]:
    """Return the effects without those that do little but beside what is withdrawn: they only make up for it.

    ``bare``: the campaign without weights, with what is known.
    """
    while kept and len(kept) < len(search.found):
        shares = []
        for f in kept:
            beside = candidates.given(bare, [o.top.term for o in kept if o is not f])
            shares.append(candidates.size_um(beside, f.top.term) / max(f.size_um, 1e-300))
        worst = int(np.argmin(shares))
        if shares[worst] >= _ALONE:
            break
        kept = [f for n, f in enumerate(kept) if n != worst]
    return kept


def halves_of_lobes(search: Search, bare: Problem, candidates: Candidates) -> list[Found]:
    """Return waves along two axes that have one length: on circles of one radius they draw lobes of something else.

    ``bare``: the campaign without weights, with what is known.
    """
    obs = bare.obs
    waves = [f for f in search.found if _length_mm(f)]
    if len(waves) < 2 or not obs.grid.in_plane or len({c.radius_mm for c in obs.conditions}) > 1:
        return []
    columns = [candidates.whitened(bare, f.top.term) for f in search.found]
    columns = [c - bare.basis @ (bare.basis.T @ c) for c in columns]
    sizes = np.linalg.lstsq(np.concatenate(columns, axis=1), bare.residual.ravel(), rcond=None)[0]
    parts = np.split(sizes, np.cumsum([c.shape[1] for c in columns])[:-1])
    made_um = {
        f.label: float(np.sqrt(((c @ a) ** 2).sum() / obs.mask.sum()))
        for f, c, a in zip(search.found, columns, parts, strict=True)
    }
    return [f for f in waves if _is_half_of_lobes(f, waves, made_um[f.label])]


def _is_half_of_lobes(wave: Found, others: Sequence[Found], made_um: float) -> bool:
    """Tell whether there is a wave of the same length along another axis.

    Screws are alike on many machines: their waves must take each other away as well. ``made_um``: what the wave makes alone.
    """
    length_mm = _length_mm(wave)
    crossing = [o for o in others if o.top.term.instance.axis != wave.top.term.instance.axis]
    alike = [o for o in crossing if abs(_length_mm(o) - length_mm) < _SAME_LENGTH * length_mm]
    return bool(alike) and (not is_periodic(wave.top.term.instance) or made_um > _TAKEN_AWAY * wave.size_um)


def _length_mm(effect: Found) -> float:
    """Return the length of the wave that an effect is, 0 for others."""
    shape = effect.top.term.shape
    return next((float(shape[name]) for name in (_WAVE, PITCH) if name in shape), 0.0)


def _is_weak(effect: Found, tests: Sequence[LawTest], search: Search) -> bool:
    """Tell whether an effect is small, and what was changed does not confirm its law, or cannot tell."""
    changed = _over_conditions(tests)
    small = effect.size_um < SPOKEN_OF * search.systematic_um[0]
    confirmed = bool(variables(effect.top, tests)[0]) or not changed
    vague = any(not t.confirmed and t.uncertainty > _VAGUE for t in changed)
    return small and (vague or not confirmed)


def _is_local(effect: Found, obs: Observations) -> bool:
    """Tell whether most of what is the same both ways along an axis happens in one place."""
    cause = effect.top.term.instance.effect
    if not obs.there_and_back or cause.law.direction != "even" or cause.within_condition:
        return False
    means = localise.condition_means(obs, does_um(effect, obs)).mean(axis=0)
    if not means.any():
        return False
    means = means[means != 0.0]
    power = (means - means.mean()) ** 2
    stretch = np.ones(max(1, len(power) // _STRETCH))
    return bool(np.convolve(power, stretch, mode="valid").max(initial=0.0) > _LOCAL * power.sum())


def _hangs_untested(effect: Found, tests: Sequence[LawTest], search: Search) -> bool:
    """Tell whether an effect that hangs on the mounting could not be compared between mountings."""
    hangs = any(name.startswith(SETUP_COLUMNS) for name in effect.top.term.instance.effect.needs)
    return hangs and len(search.plain.obs.setups) > 1 and not any(t.variable == "set-up" for t in tests)


def _over_conditions(tests: Sequence[LawTest]) -> list[LawTest]:
    return [test for test in tests if test.variable not in ("time", "delay")]
