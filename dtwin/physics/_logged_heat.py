"""Growth with a temperature that was logged, where growth with time explains the same."""

from __future__ import annotations

from collections.abc import Sequence

from dtwin.physics._score import NoiseLevel
from dtwin.physics.candidates import Candidate, Candidates
from dtwin.physics.effect import Effect
from dtwin.physics.problem import Problem, Term

# A thermometer is off by so much of a rise, or stands elsewhere: what follows it then explains no less.
_OF_LOGGED = 0.97
_SCALE = "scale"


def _follows_logged(effect: Effect, beside: Effect) -> bool:
    """Tell whether an effect follows a temperature that another one does not know."""
    return any(name.endswith("_c") for name in set(effect.needs) - set(beside.needs))


def as_good_as_logged(top: Candidate, other: Candidate) -> bool:
    """Tell whether a rival explains what an effect does but for what the temperatures that were logged may be off."""
    follows = _follows_logged(other.term.instance.effect, top.term.instance.effect)
    return follows and other.score.gain > _OF_LOGGED * top.score.gain


def logged_instead(
    problem: Problem, candidates: Candidates, top: Candidate, group: Sequence[Candidate], level: NoiseLevel
) -> tuple[tuple[Candidate, ...], list[Term]]:
    """Return what follows a logged temperature and is, beside a scale, as good as what moves with time; and the scale.

    At which temperature a scale is right nobody logs. A machine that is right when it is cold grows from its first run on.
    """
    effect, axis = top.term.instance.effect, top.term.instance.axis
    have = {c.term.label for c in group}
    alike = [i for i in candidates.instances if i.effect.name in effect.confusables and i.axis == axis]
    logged = [Term(i) for i in alike if i.label not in have and _follows_logged(i.effect, effect)]
    if not axis or not effect.within_condition or not logged:
        return (), []
    scale = [Term(i) for i in candidates.instances if i.effect.cause == _SCALE and axis in i.axis]
    beside = candidates.given(problem, scale)
    own = candidates.tested_term(beside, top.term, level)
    tested = (candidates.tested_term(beside, term, level) for term in logged)
    return tuple(c for c in tested if own and c and as_good_as_logged(own, c)), scale
