"""What a diagnosis tells of the effects of the library: those found, withdrawn, and nearest misses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from dtwin.physics import localise
from dtwin.physics._grading import SHOWN, grade_of, survivors, variables
from dtwin.physics._laws import LawTest
from dtwin.physics._rivals import Found
from dtwin.physics._search import Search
from dtwin.physics.candidates import Candidate, Candidates
from dtwin.physics.cross_validation import left_out_gain
from dtwin.physics.diagnosis import Suspect
from dtwin.physics.fit import Estimate, fit
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Problem, Term, unweighted

# Of what the best effect explains, RMS.
_NEARLY = 0.9


def sized(
    obs: Observations, known: Sequence[Term], kept: Sequence[Found], groups: Sequence[tuple[Suspect, ...]]
) -> tuple[tuple[Suspect, ...], ...]:
    """Return groups with the sizes that their first members have beside each other.

    Where these runs do not tell the size of the first one, another member that they do size leads its group.
    """
    if not kept:
        return ()
    terms = [{c.term.label: c.term for c in effect.group} for effect in kept]
    leads = [group[0].label for group in groups]
    sizes = _sizes(obs, known, terms, leads)
    for number, group in enumerate(groups):
        if _is_told(sizes[leads[number]]):
            continue
        own = terms[number]
        for other in sorted((s.label for s in group if s.label not in sizes), key=lambda n: _numbers(own[n]))[:1]:
            instead = [*leads[:number], other, *leads[number + 1 :]]
            fitted = _sizes(obs, known, terms, instead)
            if _is_told(fitted[other]):
                leads, sizes = instead, fitted
    return tuple(
        tuple(
            replace(s, sizes=sizes[lead]) if s.label == lead else s
            for s in sorted(group, key=lambda s: s.label != lead)
        )
        for lead, group in zip(leads, groups, strict=True)
    )


def _sizes(
    obs: Observations, known: Sequence[Term], terms: Sequence[Mapping[str, Term]], leads: Sequence[str]
) -> dict[str, tuple[Estimate, ...]]:
    """Return the parameters of what leads each group, all fitted together, by label.

    ``terms``: of each group, by label.
    """
    leading = {lead: own[lead] for lead, own in zip(leads, terms, strict=True)}
    estimates = [e for e in fit(obs, [*known, *leading.values()], refine=False).estimates if not e.is_unseen]
    return {lead: tuple(e for e in estimates if f"{e.effect} {e.axis}".rstrip() == lead) for lead in leading}


def _is_told(sizes: Sequence[Estimate]) -> bool:
    return any(e.identifiable for e in sizes)


def _numbers(term: Term) -> int:
    return len(term.instance.effect.parameters) + len(term.shape)


def members(
    effect: Found, tests: Mapping[str, Sequence[LawTest]], search: Search, candidates: Candidates, known: Sequence[Term]
) -> tuple[Suspect, ...]:
    """Return an effect that was found and what cannot be told from it."""
    left = survivors(effect, tests)
    labels = [c.term.label for c in effect.group]
    bare = unweighted(search.last.obs, known)
    out = []
    for candidate in left[:SHOWN]:
        own = tests.get(candidate.term.label, ())
        tested, untested = variables(candidate, own)
        own_case = suspect(candidate, bare, search, candidates, effect.gain)
        out.append(
            replace(
                own_case,
                # Alone, or beside all others that were found and for every effect that was tried.
                p_value=min(own_case.p_value, candidate.score.p_value * len(search.first.candidates)),
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
    search: Search,
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
    rest = sorted((c for c in search.first.candidates if c.term.label not in labels), key=lambda c: -c.score.gain)
    room = max(0, SHOWN - len(named))
    bare = unweighted(search.last.obs, known)
    others += withdrawn
    return (*first, *others, *(suspect(c, bare, search, candidates, None) for c in rest[:room]))


def suspect(candidate: Candidate, bare: Problem, search: Search, candidates: Candidates, gain: float | None) -> Suspect:
    """Return an effect as it stands beside what the twin knows."""
    effect = candidate.term.instance.effect
    visible = candidates.visible(bare, candidate.term)
    after = bare.extended(visible, candidates.whitened(bare, candidate.term))
    problem = search.first.problem
    if gain is None:
        gain = left_out_gain(problem, candidates.whitened(problem, candidate.term))
    total = max(search.systematic_um[0] ** 2 * float(bare.obs.mask.sum()), 1e-18)
    return Suspect(
        effect=effect.name,
        axis=candidate.term.instance.axis,
        rms_after_um=bare.obs.rms(localise.in_angle(after)),
        cv_gain=gain,
        p_value=search.first.p_values.get(candidate.term.label, candidate.score.p_value),
        in_group=False,
        grade=None,
        confounded_with=(),
        laws=(),
        share=min(1.0, float(((visible.T @ bare.residual.ravel()) ** 2).sum()) / total),
        remedy=effect.remedy,
        shape=candidate.term.shape,
    )


def closest(search: Search, candidates: Candidates) -> str | None:
    """Return the simplest effect that explains nearly as much as any; of those that few runs do not tell, the one that explains most."""
    untold = [c for c in search.first.candidates if c.term.label in search.untold]
    if untold:
        # They act between repeats: nothing of what repeats agree on is theirs.
        return max(untold, key=lambda c: c.score.gain).term.label
    terms = [c.term for c in search.first.candidates]
    explains_um = {term.label: candidates.size_um(search.plain, term) for term in terms}
    most_um = max(explains_um.values(), default=0.0)
    near = [term for term in terms if most_um > 0.0 and explains_um[term.label] > _NEARLY * most_um]
    return min(near, key=lambda t: (candidates.numbers(t), -explains_um[t.label])).label if near else None
