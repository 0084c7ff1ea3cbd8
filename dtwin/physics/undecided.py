"""Which effects of a twin its runs cannot tell from others."""

from __future__ import annotations

from collections.abc import Collection, Hashable, Mapping, Sequence
from dataclasses import replace

from dtwin.physics._best_set import away_from_reversals, is_sharp
from dtwin.physics._grading import laws_of, survivors
from dtwin.physics._hunt import MISFIT, repeat_variance
from dtwin.physics._measured_once import as_if_repeated
from dtwin.physics._one_size import of_other_sizes
from dtwin.physics._rivals import described
from dtwin.physics.candidates import Candidates, applicable
from dtwin.physics.diagnosis import Diagnosis
from dtwin.physics.effect import Effect
from dtwin.physics.joint import MachineTest, joint
from dtwin.physics.machine_terms import key_of
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Problem, Term, set_up, unweighted, weighted_like

# Of the copies of runs that were measured once.
_SEED = 0
_MANY = 12


def undecided(obs: Observations, known: Sequence[Term], library: Mapping[str, Effect]) -> tuple[tuple[str, ...], ...]:
    """Return each effect of a twin that these runs cannot tell from others, and those; labels.

    Each is judged as if it had just been found: whoever chose it from a group did not decide the group. A correction is
    asked for more: there each effect is left out and must be found again. Circles that were measured once are judged by
    the least noise that they can have; nothing is said of other runs without repeats.

    ``obs``: without the runs that are not like their repeats.
    """
    if not known:
        return ()
    tried, _ = applicable(library, obs, [])
    within = [Term(i, i.effect.start_shape) for i in tried if i.effect.within_condition]
    problem = set_up(obs, [], within)
    if problem.noise is None:
        copied = as_if_repeated(obs, known, _SEED)
        return () if copied is None else undecided(copied[0], known, library)
    whole = part = Candidates(obs, tried)
    told = problem
    if obs.grid.in_plane and _laws_are_off(problem, known, whole):
        part = Candidates(away_from_reversals(obs), tried)
        told = weighted_like(part.obs, [], problem.noise)
    effects = described(known, {}, told, part, problem, unweighted(obs, []), whole)
    groups = [[f.label, *(c.term.label for c in survivors(f, laws_of(f, len(effects))))] for f in effects]
    return tuple(group for group in (tuple(dict.fromkeys(group)) for group in groups) if len(group) > 1)


def undecided_together(
    tests: Sequence[MachineTest],
    doubts: Sequence[Mapping[str, tuple[str, ...]]],
    library: Mapping[str, Effect],
    absent: Collection[Hashable] = (),
) -> tuple[tuple[str, ...], ...]:
    """Return the same of a twin of several campaigns: what none of them decides, nor all of them together.

    ``tests``: with what the twin knows of each; labels are those that a cause has there.
    ``doubts``: of each test, as :func:`doubts_of` gives them.
    ``absent``: keys of the effects of the twin that are nothing to within their uncertainty. What could stand in their place
    has no size in any test either: where it is very much, none of it is asked.
    """
    groups = [[doubt.get(t.label, (t.label,)) for t in test.known] for test, doubt in zip(tests, doubts, strict=True)]
    settled = joint([replace(test, known=()) for test in tests], library, groups).settled
    left = {(s.campaign, s.group): s.left for s in settled}
    terms = {key_of(term): term for test in tests for term in test.known}
    campaigns = [test.obs for test in tests]
    shortest: dict[Hashable, tuple[str, ...]] = {}
    doubted = [
        (test, term, [label for label in left.get((test.campaign, group), group) if label != term.label])
        for test, own in zip(tests, groups, strict=True)
        for term, group in zip(test.known, own, strict=True)
    ]
    # A test of few runs leaves most of the library open: it need not be asked where another one leaves less, nor further
    # than to know that it leaves very many.
    for test, term, others in sorted(doubted, key=lambda doubt: len(doubt[2])):
        known = [each for key, each in terms.items() if key != key_of(term)]
        so_far = shortest.get(key_of(term))
        most = _MANY if so_far is None else min(_MANY, len(so_far) - 1)
        asked = [] if key_of(term) in absent and len(others) > _MANY else others
        differ = of_other_sizes(asked, known, campaigns, test.obs.grid.kind, library, most=most)
        group = (term.label, *(label for label in others if label not in differ))
        shortest[key_of(term)] = group if so_far is None else min(so_far, group, key=len)
    return tuple(group for key in terms if len(group := shortest[key]) > 1)


def doubts_of(test: MachineTest, library: Mapping[str, Effect]) -> dict[str, tuple[str, ...]]:
    """Return what a test alone cannot tell from each effect of the twin, by its label; labels, that one first."""
    groups = undecided(like_repeats(test.obs, test.found), test.known, library)
    return {group[0]: group for group in groups}


def like_repeats(obs: Observations, diagnosis: Diagnosis) -> Observations:
    """Return observations without the runs that a diagnosis left out, not being like their repeats."""
    return obs.without([n for n, run in enumerate(obs.runs) if run.run_id in diagnosis.outlier_runs])


def _laws_are_off(problem: Problem, known: Sequence[Term], candidates: Candidates) -> bool:
    """Tell whether effects leave more than noise, or more near reversals than elsewhere."""
    left = float((candidates.given(problem, known).residual ** 2).sum())
    return left > MISFIT * repeat_variance(problem) * problem.obs.mask.sum() or is_sharp(problem, known)
