"""Which effects of a twin its runs cannot tell from others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from dtwin.physics._grading import laws_of, survivors
from dtwin.physics._hunt import MISFIT, away_from_reversals, is_sharp, repeat_variance
from dtwin.physics._rivals import described
from dtwin.physics.candidates import Candidates, applicable
from dtwin.physics.effect import Effect
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Problem, Term, set_up, unweighted, weighted_like


def undecided(obs: Observations, known: Sequence[Term], library: Mapping[str, Effect]) -> tuple[tuple[str, ...], ...]:
    """Return each effect of a twin that these runs cannot tell from others, and those; labels.

    Each is judged as if it had just been found: whoever chose it from a group did not decide the group. Nothing where
    no run was repeated.

    ``obs``: without the runs that are not like their repeats.
    """
    tried, _ = applicable(library, obs, [])
    within = [Term(i, i.effect.start_shape) for i in tried if i.effect.within_condition]
    problem = set_up(obs, [], within)
    if problem.noise is None or not known:
        return ()
    whole = part = Candidates(obs, tried)
    told = problem
    if obs.grid.kind == "circular" and _laws_are_off(problem, known, whole):
        part = Candidates(away_from_reversals(obs), tried)
        told = weighted_like(part.obs, [], problem.noise)
    found = described(known, {}, told, part, problem, unweighted(obs, []), whole)
    groups = [[f.label, *(c.term.label for c in survivors(f, laws_of(f, len(found))))] for f in found]
    return tuple(group for group in (tuple(dict.fromkeys(group)) for group in groups) if len(group) > 1)


def _laws_are_off(problem: Problem, known: Sequence[Term], candidates: Candidates) -> bool:
    """Tell whether effects leave more than noise, or more near reversals than elsewhere."""
    left = float((candidates.given(problem, known).residual ** 2).sum())
    return left > MISFIT * repeat_variance(problem) * problem.obs.mask.sum() or is_sharp(problem, known)
