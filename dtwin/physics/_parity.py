"""Along an axis: what is the same both ways and what is not, each told beside any curve of the other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from dtwin.physics import localise
from dtwin.physics._local_laws import MOST_TARGETS
from dtwin.physics._rivals import Found
from dtwin.physics._search import Search
from dtwin.physics._trust import does_um
from dtwin.physics.candidates import Candidates
from dtwin.physics.diagnosis import Diagnosis, Suspect
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Problem
from dtwin.schema import Floats
from dtwin.units import shown_number

# A parity of which less is left, as RMS beside the other, stands in nobody's way.
_STANDS = 0.3
# What is seen only beside any curve must be surer and larger than what a search finds by itself.
_SURE = 0.05
_SIZE = 0.5
# What looks like what is left of the other parity is a part of something that has both.
_ALIKE = 0.7
# What varies by a smaller share of itself along the travel has no form there.
_FORM = 0.2

Curve = Callable[[Problem], Problem]


def curves_left(answer: Diagnosis, first: Search, plain: Problem, candidates: Candidates) -> list[Curve]:
    """Return what takes any curve of a parity out of a problem, for each parity of which much is left.

    ``plain``: the campaign without weights, with what is known.
    """
    obs = plain.obs
    if not obs.there_and_back or obs.n_bins > MOST_TARGETS:
        return []
    left = localise.in_angle(candidates.given(plain, [f.top.term for f in _leaders(answer.found, first)]))
    means = localise.condition_means(obs, left)
    ways = np.array([c.sense for c in obs.conditions])
    signs = ((np.ones(len(ways)), np.ones(obs.n_rows)), (ways, obs.sense))
    sizes = [float(np.linalg.norm(of_condition @ means)) for of_condition, _ in signs]
    return [_beside(of_row) for (_, of_row), size in zip(signs, sizes, strict=True) if size > _STANDS * max(sizes)]


def _beside(signs: Floats) -> Curve:
    def without(problem: Problem) -> Problem:
        obs = problem.obs
        columns = signs[:, None, None] * np.eye(obs.n_bins) * obs.mask[:, :, None]
        whitened = problem.whitened(columns)
        return problem.extended(problem.visible(whitened)[0], whitened)

    return without


def joined(
    answer: Diagnosis, others: Sequence[Diagnosis], searches: Sequence[Search], plain: Problem, candidates: Candidates
) -> Diagnosis:
    """Return an answer with what is told beside any curve, and what all of it leaves.

    ``others``: answers beside a curve.
    ``searches``: what gave the answer and the others.
    ``plain``: the campaign without weights, with what is known.
    """
    obs, before = plain.obs, answer.unresolved
    groups, kept = list(answer.found), _leaders(answer.found, searches[0])
    left = localise.in_angle(candidates.given(plain, [f.top.term for f in kept]))
    for other, search in zip(others, searches[1:], strict=True):
        for group in other.found:
            lead, leaders = group[0], _leaders([group], search)
            sure = (lead.size_um or 0.0) >= _SIZE * answer.noise_floor_um and lead.p_value <= _SURE
            new = lead.label not in {s.label for g in groups for s in g}
            if new and sure and not any(_looks_like(does_um(f, obs), left, obs) for f in leaders):
                groups.append(group)
                kept += leaders
    if len(groups) == len(answer.found) or before is None:
        return answer
    left = localise.in_angle(candidates.given(plain, [f.top.term for f in kept]))
    rms_um = localise.systematic_rms_um(obs, left)
    words = localise.headline(obs, left)
    labels = {s.label for group in groups for s in group}
    rest = (s for s in answer.suspects if s.label not in labels)
    names = "; ".join(" or ".join(s.label for s in group) for group in groups)
    return replace(
        answer,
        verdict="missing_effect" if len(groups[0]) == 1 else "ambiguous",
        headline=f"{names}; besides, {shown_number(rms_um, 2)} µm is not resolved: {words}",
        found=tuple(groups),
        suspects=(*_as_shown(groups), *rest),
        closest=None,
        unresolved=replace(
            before,
            systematic_rms_um=rms_um,
            share=min(1.0, before.share * (rms_um / before.systematic_rms_um) ** 2),
            words=words,
            where=localise.worst_places(obs, left),
        ),
    )


def _looks_like(does: Floats, left: Floats, obs: Observations) -> bool:
    """Tell whether what an effect does along the travel has the form of what is left, whatever the parity of both.

    ``does``, ``left``: um, shape (rows, n).
    """
    own = max(_profiles(does, obs), key=lambda profile: float(np.linalg.norm(profile)))
    form = own - own.mean()
    if np.linalg.norm(form) < _FORM * np.linalg.norm(own):
        return False
    others = [profile - profile.mean() for profile in _profiles(left, obs)]
    return any(abs(form @ other) > _ALIKE * np.linalg.norm(form) * np.linalg.norm(other) for other in others)


def _profiles(values: Floats, obs: Observations) -> tuple[Floats, Floats]:
    """Return the mean along the travel of what is the same both ways, and of what changes its sign, shape (n,) each."""
    means = localise.condition_means(obs, values)
    ways = np.array([c.sense for c in obs.conditions])
    return means.mean(axis=0), np.asarray(ways @ means / len(ways))


def _as_shown(groups: Sequence[Sequence[Suspect]]) -> list[Suspect]:
    """Return the members of all groups; those of the first are the reported group."""
    return [replace(s, in_group=group is groups[0]) for group in groups for s in group]


def _leaders(groups: Sequence[Sequence[Suspect]], search: Search) -> list[Found]:
    """Return what a search found of each group; another member may give the group its name."""
    by_label = {f.label: f for f in search.found}
    return [
        next(by_label[s.label] for s in group if s.label in by_label)
        for group in groups
        if {s.label for s in group} & set(by_label)
    ]
