"""Whether the laws of what was found hold, and what that makes of a name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from dtwin.physics._laws import LawTest, law_tests
from dtwin.physics._rivals import Found
from dtwin.physics.candidates import Candidate
from dtwin.physics.diagnosis import Grade

SHOWN = 8
# Half the relative difference between the directions: 1 for an effect that acts in one of them only.
_ONE_WAY = 0.6


def laws_of(effect: Found, effects: int) -> Mapping[str, list[LawTest]]:
    """Test the laws of an effect and its rivals with all other effects taken out, by label.

    What cannot be seen beside it may be a part of it only: its law is not that of the whole. The
    p-values are Bonferroni's over all the effects found; few of them have a channel that may be late.
    """
    out = {}
    for candidate in effect.group[:SHOWN]:
        if candidate.term.label not in effect.absorbed:
            tests = [
                test if test.variable == "delay" else replace(test, p_value=min(1.0, effects * test.p_value))
                for test in _own_tests(effect, candidate)
            ]
            out[candidate.term.label] = tests if effect.level.misfit is None else [_beside_unknown(t) for t in tests]
    return out


def _beside_unknown(test: LawTest) -> LawTest:
    """Return a test where something unknown is left: it may be all that differs between directions.

    An unknown error that is the same both ways adds to an effect that turns with the direction in one of them, and takes from
    it in the other. Such a law is not confirmed; it is broken where the effect acts nearly in one direction only.
    """
    if test.variable != "direction" or not test.broken or abs(test.shift) > _ONE_WAY:
        return test
    return replace(test, p_value=1.0, uncertainty=abs(test.shift))


def _own_tests(effect: Found, candidate: Candidate) -> list[LawTest]:
    """Test the law of a member of a group, beside the others where only all of them together are a rival."""
    problem, library, own = effect.problem, effect.candidates, candidate.term
    if own.label not in effect.together:
        return law_tests(problem, library, candidate, effect.level)
    problem = library.given(problem, effect.together[own.label])
    beside = library.tested_term(problem, own, effect.level)
    return [] if beside is None else law_tests(problem, library, beside, effect.level)


def survivors(effect: Found, tests: Mapping[str, Sequence[LawTest]]) -> list[Candidate]:
    """Return the members of a group whose laws hold.

    Where that of the top one does not, one with more numbers only hides that.
    """
    most = _numbers(effect.top) if _broken(tests.get(effect.label, ())) else np.inf
    return [c for c in effect.group if _numbers(c) <= most and not _broken(tests.get(c.term.label, ()))]


def _numbers(candidate: Candidate) -> int:
    return candidate.visible.shape[1] + len(candidate.term.shape)


def _broken(tests: Sequence[LawTest]) -> bool:
    return any(test.broken for test in tests)


def variables(candidate: Candidate, tests: Sequence[LawTest]) -> tuple[list[str], list[str]]:
    """Return the variables of a law that were confirmed, and those that were not."""
    law = candidate.term.instance.effect.law
    wanted = [name for name, exponent in (("feed", law.feed), ("radius", law.radius)) if exponent is not None]
    wanted += ["direction"] if law.direction != "mixed" else []
    confirmed = {test.variable for test in tests if test.confirmed}
    return [n for n in wanted if n in confirmed], [n for n in wanted if n not in confirmed]


def grade_of(candidate: Candidate, tests: Sequence[LawTest], alone: bool) -> Grade:
    """Grade a name: its law counts as confirmed when every variable of it was."""
    law = candidate.term.instance.effect.law
    enough = law.feed is not None and not _broken(tests) and not variables(candidate, tests)[1]
    return "law-confirmed" if enough and alone else "shape-consistent"
