"""A twin as one of its tests of a path sees it, and how it is fitted again to less: what a correction is made from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.kinds.registry import kind_named
from dtwin.lake.store import Lake
from dtwin.physics.agreed import Sizes
from dtwin.physics.contradictions import Contradiction
from dtwin.physics.diagnose import diagnose
from dtwin.physics.diagnosis import Diagnosis, Suspect
from dtwin.physics.fit import fit
from dtwin.physics.gridding import Indices
from dtwin.physics.machine_terms import cause_of, key_of, seen_by
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Term
from dtwin.physics.several_diagnosis import diagnose_several
from dtwin.physics.several_sizes import covariance_in
from dtwin.physics.several_twin import SeenTwin, SeveralTwin, seen_in
from dtwin.physics.state import AXES_OF
from dtwin.physics.twin import Twin, twin_of
from dtwin.twins._learned import WithLearned
from dtwin.twins._machine_twins import MachineTwins
from dtwin.twins._path_member import PathMember
from dtwin.twins.measured import load
from dtwin.twins.members import Cause, Member, Version
from dtwin.twins.of_kind import AnyTwin, AnyTwins
from dtwin.twins.verbs import Twins

_Rows = Callable[[Observations], Indices]
"""Which rows of a campaign a fit takes."""
_Agree = Callable[[PathMember, Sizes], Sizes]
"""What fits of other kinds make of the sizes of one."""


@dataclass(frozen=True)
class Seen:
    """A twin as one campaign of a path sees it.

    ``twin``: with the effects by the names that they have there.
    ``obs``: the runs of the campaign.
    ``whole``, ``tests``: the twin of all its tests of a path, the same one where there is one test, and those tests.
    ``contradictions``: what all campaigns of the twin, of any kinds, do not agree on.
    ``library``: effects that may be missing.
    ``refit``: fits the effects again to some rows of each test, and returns the twin as this campaign sees it. Raises
    ``InputError`` when no row is left.
    ``lacks``: diagnoses all tests without an effect of the twin, or with all of them.
    ``elsewhere``: returns the campaigns of other kinds that name the cause of an effect again, and alone, without it.
    """

    twin: Twin
    obs: Observations
    whole: Twin
    tests: tuple[Observations, ...]
    contradictions: tuple[Contradiction, ...]
    library: WithLearned
    refit: Callable[[_Rows], Twin]
    lacks: Callable[[Term | None, int], Diagnosis]
    elsewhere: Callable[[Term, int], Sequence[str]] = lambda term, seed: ()

    def key_of(self, suspect: Suspect) -> tuple[str, str]:
        """Return cause and axis of what was found, as those of a term."""
        return cause_of(self.library[suspect.effect]), suspect.axis

    def disagreed_on(self, term: Term) -> list[Contradiction]:
        """Return the contradictions on the size of an effect."""
        cause, axis = key_of(term)
        return [
            c
            for c in self.contradictions
            if (cause_of(self.library[c.effect]) if c.effect in self.library else c.effect) == cause
            and axis in (c.axis, *AXES_OF.get(c.axis, ()))
        ]


def able_to(home: Home, twin: AnyTwin, verb: str) -> list[str]:
    """Return the campaigns of a twin whose kind has a verb."""
    lake = Lake(home.lake)
    return [name for name in twin.campaigns if kind_named(lake.campaign(name).kind).offers(verb)]


def chosen(home: Home, twin: AnyTwin, verb: str, campaign: str | None) -> str:
    """Return the campaign of a twin for which a verb is asked; without a name the only one that has it.

    Raises ``NotOffered`` when it does not have the verb, ``InputError`` when it is not said which of several is meant.
    """
    if campaign is not None and campaign not in twin.campaigns:
        raise InputError(
            "the twin was not fitted to this campaign",
            code="twin.campaign",
            where=f"twin {twin.name} version {twin.version}",
            got=campaign[:80],
            allowed=", ".join(twin.campaigns),
        )
    able = able_to(home, twin, verb)
    if campaign is None and len(able) > 1:
        raise InputError(
            "of which campaign of the twin?",
            code="twin.which",
            where=f"twin {twin.name} version {twin.version}",
            allowed=", ".join(able),
            hint=f"--on {able[0]}",
        )
    name = campaign or next(iter(able), twin.campaigns[0])
    kind_named(Lake(home.lake).campaign(name).kind).require(verb)
    return name


def seen_on(twins: AnyTwins, name: str, campaign: str) -> Seen:
    """Return the newest version of a twin as one of its campaigns of a path sees it."""
    if isinstance(twins, MachineTwins):
        machine = twins.newest(name)
        seen = _of_several(*twins.of_paths(machine), campaign, machine.contradictions)
        members = list(zip(twins.members_of(machine.campaigns), machine.members, strict=True))
        return replace(seen, elsewhere=lambda term, seed: _named_again(members, key_of(term), seed))
    paths = cast("Twins", twins)
    known = paths.newest(name)
    if isinstance(known, SeveralTwin):
        (member,) = paths.members(known.campaigns)
        return _of_several(member, known, _as_they_are, campaign, known.contradictions, paths)
    return _of_one(paths, known)


def _named_again(members: Sequence[tuple[Member, Any]], cause: Cause, seed: int) -> list[str]:
    """Return the campaigns of no path which, diagnosed without a cause that they show, name it again and nothing in its place."""
    out: list[str] = []
    for member, part in members:
        rest = tuple(term for term in part.terms if member.cause(term) != cause)
        if isinstance(member, PathMember) or len(rest) == len(part.terms):
            continue
        alone = [group[0] for group in member.told(replace(part, terms=rest), seed).found if len(group) == 1]
        if any(cause in map(member.cause, member.named(label)) for label in alone):
            out += member.campaigns
    return out


def _as_they_are(_: PathMember, sizes: Sizes) -> Sizes:
    return sizes


def _of_one(twins: Twins, twin: Twin) -> Seen:
    obs = load(twins.home, twin.campaign).obs

    def refit(rows: _Rows) -> Twin:
        kept = rows(obs)
        if not len(kept):
            raise _nothing_left(obs.campaign.name)
        rest = obs.take(kept)
        return twin_of(fit(rest, list(twin.terms)), rest, name=twin.name, version=twin.version, action="", data={})

    def lacks(without: Term | None, seed: int) -> Diagnosis:
        if without is None:
            return twins.diagnose(twin.name, seed=seed)[1]
        return diagnose(obs, [t for t in twin.terms if t.label != without.label], twins.library, seed=seed)

    return Seen(twin, obs, twin, (obs,), (), twins.library, refit, lacks)


def _of_several(
    member: PathMember,
    twin: SeveralTwin,
    agree: _Agree,
    on: str,
    contradictions: Sequence[Contradiction],
    diagnosed: Twins | None = None,
) -> Seen:
    """``agree``: what fits of other kinds make of the sizes; ``diagnosed``: the twins that keep the diagnosis of this one."""
    library = member.library
    campaigns = member.observations
    number = member.campaigns.index(on)
    obs = campaigns[number]

    def refit(rows: _Rows) -> Twin:
        rest = member.only(rows)
        if rest is None:
            raise _nothing_left(twin.campaign)
        return seen_in(_fitted(rest, twin, agree)[0], obs, library)[0]

    def lacks(without: Term | None, seed: int) -> Diagnosis:
        if without is None:
            return diagnosed.diagnose(twin.name, seed=seed)[1] if diagnosed else _diagnosed(twin, seed)
        gone = key_of(without)
        parts = tuple(replace(p, terms=_without(p.terms, gone)) for p in twin.parts)
        # What campaigns do not agree on is told of the twin as it is.
        return _diagnosed(replace(twin, terms=_without(twin.terms, gone), parts=parts, contradictions=()), seed)

    def _diagnosed(one: SeveralTwin, seed: int) -> Diagnosis:
        return diagnose_several(one, campaigns, library, seed=seed)

    _, covariance = _fitted(member, twin, agree, refine=False, of=number)
    seen = SeenTwin(**vars(twin.on(on)), covariance=covariance)
    return Seen(seen, obs, twin, tuple(campaigns), tuple(contradictions), library, refit, lacks)


def _without(terms: Sequence[Term], gone: tuple[str, str]) -> tuple[Term, ...]:
    return tuple(term for term in terms if key_of(term) != gone)


def _fitted(
    member: PathMember, twin: SeveralTwin, agree: _Agree, *, refine: bool = True, of: int = 0
) -> tuple[SeveralTwin, np.ndarray]:
    """Return the effects of a twin fitted to campaigns, and the covariance of the parameters that one of them sees."""
    terms = [t for t in twin.terms if any(seen_by(t, obs, member.library) for obs in member.observations)]
    fitted = member.fit(terms, robust=False, refine=refine)
    sizes = agree(member, member.sizes(fitted))
    made = member.twin(fitted, sizes, Version(twin.name, twin.version, ""))
    return made, covariance_in(fitted[0], sizes, of)


def _nothing_left(where: str) -> InputError:
    return InputError("no run is left to fit to", code="twin.no_runs", where=where)
