"""What a diagnosis tells of the effects of the library: those found, withdrawn, and nearest misses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from dtwin.physics import localise
from dtwin.physics._grading import SHOWN, grade_of, survivors, variables
from dtwin.physics._laws import LawTest
from dtwin.physics._rivals import Found
from dtwin.physics.candidates import Candidate, Candidates
from dtwin.physics.cross_validation import left_out_gain
from dtwin.physics.diagnosis import Suspect
from dtwin.physics.fit import fit
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Problem, Term, unweighted
from dtwin.physics.search import Search


def sized(
    obs: Observations, known: Sequence[Term], kept: Sequence[Found], groups: Sequence[tuple[Suspect, ...]]
) -> tuple[tuple[Suspect, ...], ...]:
    """Return groups with the sizes that their first members have beside each other."""
    if not kept:
        return ()
    estimates = fit(obs, [*known, *(f.top.term for f in kept)], refine=False).estimates
    out = []
    for effect, (first, *others) in zip(kept, groups, strict=True):
        sizes = tuple(e for e in estimates if f"{e.effect} {e.axis}".rstrip() == effect.label)
        out.append((replace(first, sizes=sizes), *others))
    return tuple(out)


def members(
    effect: Found, tests: Mapping[str, Sequence[LawTest]], found: Search, candidates: Candidates, known: Sequence[Term]
) -> tuple[Suspect, ...]:
    """Return an effect that was found and what cannot be told from it."""
    left = survivors(effect, tests)
    labels = [c.term.label for c in effect.group]
    bare = unweighted(found.last.obs, known)
    out = []
    for candidate in left[:SHOWN]:
        own = tests.get(candidate.term.label, ())
        tested, untested = variables(candidate, own)
        own_case = suspect(candidate, bare, found, candidates, effect.gain)
        out.append(
            replace(
                own_case,
                in_group=True,
                grade=grade_of(candidate, own, len(left) == 1),
                confounded_with=tuple(sorted(set(labels) - {candidate.term.label})),
                laws=tuple(own),
                size_um=effect.size_um,
                tested=tuple(tested),
                untested=tuple(untested),
            )
        )
    return tuple(out)


def suspects(
    found: Search,
    candidates: Candidates,
    known: Sequence[Term],
    groups: Sequence[Sequence[Suspect]],
    withdrawn: Sequence[Suspect] = (),
) -> tuple[Suspect, ...]:
    """Return the largest effect that was found with its rivals, the other ones, and the nearest misses."""
    named = [*(s for group in groups for s in group), *withdrawn]
    labels = {s.label for s in named}
    first = [replace(s, in_group=True) for s in (groups[0] if groups else ())]
    others = [replace(s, in_group=False) for group in groups[1:] for s in group]
    rest = sorted((c for c in found.first.candidates if c.term.label not in labels), key=lambda c: -c.score.gain)
    room = max(0, SHOWN - len(named))
    bare = unweighted(found.last.obs, known)
    others += withdrawn
    return (*first, *others, *(suspect(c, bare, found, candidates, None) for c in rest[:room]))


def suspect(candidate: Candidate, bare: Problem, found: Search, candidates: Candidates, gain: float | None) -> Suspect:
    """Return an effect as it stands beside what the twin knows."""
    effect = candidate.term.instance.effect
    visible = candidates.visible(bare, candidate.term)
    after = bare.extended(visible, candidates.whitened(bare, candidate.term))
    problem = found.first.problem
    if gain is None:
        gain = left_out_gain(problem, candidates.whitened(problem, candidate.term))
    total = max(found.systematic_um[0] ** 2 * float(bare.obs.mask.sum()), 1e-18)
    return Suspect(
        effect=effect.name,
        axis=candidate.term.instance.axis,
        rms_after_um=bare.obs.rms(localise.in_angle(after)),
        cv_gain=gain,
        p_value=found.first.p_values.get(candidate.term.label, candidate.score.p_value),
        in_group=False,
        grade=None,
        confounded_with=(),
        laws=(),
        share=min(1.0, float(((visible.T @ bare.residual.ravel()) ** 2).sum()) / total),
        remedy=effect.remedy,
    )
