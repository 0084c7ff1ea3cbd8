"""Twins of campaigns of several kinds: fit, compare, diagnose, add, remove, restore, discover."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

from dtwin.config import Home
from dtwin.documents import unknown_form
from dtwin.errors import InputError
from dtwin.kinds.registry import kind_named
from dtwin.lake.store import Lake
from dtwin.physics.agreed import Quantity, Sizes, agreed, contradicting
from dtwin.physics.contradictions import Contradiction
from dtwin.physics.effect import Effect
from dtwin.physics.fit import Estimate
from dtwin.physics.several_twin import SeveralTwin
from dtwin.schema import require_name
from dtwin.twins._kept_diagnosis import MADE_FROM, kept_document, made_from_rows, recorded
from dtwin.twins._learned import contradictions_from
from dtwin.twins._path_member import PathMember
from dtwin.twins.machine_twin import (
    FORMAT,
    MACHINE,
    REPLICATION,
    MachineComparison,
    MachineDiagnosis,
    MachineTwin,
    effects_of,
    figures_of,
    shared_of,
    size_of,
)
from dtwin.twins.members import Cause, HasMembers, Member, Version, known_to, told_from, widened
from dtwin.twins.shelf import PATHS, TwinShelf, effect_absent, effect_there, logged_together, require_same_machine

_MOST_RUNGS = 40
# A size is there from three of its standard uncertainties on; sizes have k = 2.
_THERE = 1.5
_Terms = Sequence[Sequence[Any]]


class MachineTwins(TwinShelf):
    """The twins of a home that are of campaigns of several kinds, or of several for which one fit is not enough.

    Verbs, and what they refuse and return, are those of :class:`dtwin.twins.verbs.Twins`.
    """

    def __init__(self, home: Home, library: Mapping[str, Effect] | None = None) -> None:
        super().__init__(home, MACHINE)
        self._library = library

    def fit(
        self, campaign: str | Sequence[str], effects: Sequence[str], name: str, *, robust: bool = False
    ) -> MachineTwin:
        """Fit a twin to campaigns of a machine; an effect goes to all campaigns that show its cause."""
        require_name(name, "the twin")
        twin = self.fitted([campaign] if isinstance(campaign, str) else campaign, effects, name, robust=robust)
        self.store(twin.as_dict(), ahead=True)
        return twin

    def fitted(
        self, campaigns: Sequence[str], effects: Sequence[str], name: str, *, robust: bool = False
    ) -> MachineTwin:
        """Return the same, without storing it."""
        members = self.members_of(campaigns)
        terms = self._widened(members, [()] * len(members), effects, "")
        return self._made(self._of(name, members, "fit"), members, terms, robust=robust)

    def compare(self, name: str, campaign: str | None = None) -> Any:
        """Compare a twin with its campaigns, or with one: of the fit, or another of a kind that it has."""
        twin = self.newest(name)
        if campaign is None:
            members = self.members_of(twin.campaigns)
            parts = (member.compared(part) for member, part in zip(members, twin.members, strict=True))
            return MachineComparison(twin, tuple(parts))
        known = Lake(self.home.lake).campaign(campaign)
        require_same_machine(name, twin.machine, campaign, known.machine)
        shelf = self._shelf(known.kind)
        alike = [part for part in twin.members if part.as_dict().get("kind", PATHS) == shelf.kind]
        own = [part for part in alike if campaign in part.campaigns]
        if not alike:
            raise InputError(
                "the twin has no campaign of this kind",
                code="twin.kind",
                where=f"twin {name}",
                got=f"{campaign}, {known.kind}",
                allowed=", ".join(dict.fromkeys(one["kind"] for one in twin.document["campaigns"])),
                hint=f"dtwin twin fit {' '.join(twin.campaigns)} {campaign} --name {name}",
            )
        return shelf.against((own or alike[-1:])[0], campaign)

    def diagnose(self, name: str, *, seed: int = 0) -> tuple[MachineTwin, MachineDiagnosis]:
        """Find out what a twin lacks, each fit by what its kind of campaign can show."""
        twin = self.newest(name)
        return twin, self._diagnosed(twin, self.members_of(twin.campaigns), seed)

    def add(self, name: str, effect: str, axis: str = "") -> MachineTwin:
        """Add an effect wherever its cause shows, refit, and store the new version."""
        twin = self.newest(name)
        members = self.members_of(twin.campaigns)
        terms = self._widened(members, _terms(twin), [effect], axis)
        if not _fresh(members, _terms(twin), terms):
            raise effect_there(twin, effect)
        of = self._after(twin, _added(members, _terms(twin), terms))
        return self._store(of, members, terms, ahead=True)

    def remove(self, name: str, effect: str, axis: str = "") -> MachineTwin:
        """Take a cause out of all campaigns, refit, and store the new version."""
        twin = self.newest(name)
        members = self.members_of(twin.campaigns)
        kept = self._without(members, _terms(twin), effect, axis)
        if sum(map(len, kept)) == sum(map(len, _terms(twin))):
            raise effect_absent(twin, effect)
        of = self._after(twin, f"remove {effect}{f':{axis}' if axis else ''}")
        return self._store(of, members, kept, ahead=True)

    def restore(self, name: str, version: int) -> MachineTwin:
        """Refit with the effects of an older version, and store that as a new one."""
        old = self.newest(name, version)
        members = self.members_of(old.campaigns)
        return self._store(self._of(name, members, f"restore v{version}"), members, _terms(old), ahead=True)

    @logged_together
    def discover(
        self, name: str, *, seed: int = 0
    ) -> tuple[list[MachineTwin], list[tuple[str, ...]], MachineDiagnosis]:
        """Diagnose and add until no campaign lacks anything; what pays nothing beside the others is taken out again.

        Causes that several campaigns show come first: what one campaign finds beside them may be another name for them. What
        one finds, and all that see it together do not, is not added.
        """
        twin = self.newest(name)
        members = self.members_of(twin.campaigns)
        made: list[MachineTwin] = []
        groups: list[tuple[str, ...]] = []
        tried: set[str] = set()
        denied: list[str] = []
        said = self._diagnosed(twin, members, seed)
        while len(made) < _MOST_RUNGS:
            before = len(made)
            for group in self._next(twin, members, said, first=not made):
                terms = self._widened(members, _terms(twin), [group[0]], "")
                if group[0] in tried or not _fresh(members, _terms(twin), terms):
                    continue
                tried.add(group[0])
                new = self._made(self._after(twin, _added(members, _terms(twin), terms)), members, terms)
                if _denied(new, twin):
                    denied.append(group[0])
                    continue
                self.store(new.as_dict())
                twin = new
                made.append(new)
                groups.append(group)
            if len(made) == before:
                idle = self._idle(twin, said)
                if not idle:
                    break
                tried.add(idle)
                kept = self._without(members, _terms(twin), idle, "")
                of = self._after(twin, f"remove {idle}: it pays nothing beside the others")
                twin = self._store(of, members, kept)
                made.append(twin)
                groups = [group for group in groups if group[0] != idle]
            said = self._diagnosed(twin, members, seed)
        return made, groups, replace(said, denied=tuple(denied))

    def _next(
        self, twin: MachineTwin, members: Sequence[Member], said: MachineDiagnosis, *, first: bool
    ) -> list[tuple[str, ...]]:
        """Return the groups to add before the next diagnosis: those of causes that several campaigns show, else all."""
        every = [group for told in said.told for group in (told.found if first else told.surely)]
        old = _terms(twin)
        by_group = [(group, self._widened(members, old, [group[0]], "")) for group in every]
        shared = [
            group
            for group, new in by_group
            if sum(len(mine) > len(before) for mine, before in zip(new, old, strict=True)) > 1
        ]
        return sorted(shared, key=len)[:1] or every

    def causes(self, campaigns: Sequence[str], effect: str) -> list[Cause]:
        """Return what of the machine an effect measures, by the name that it has in one of the campaigns."""
        told = [(member, known_to(member, effect, "")[0]) for member in self.members_of(campaigns)]
        return [cause for member, terms in told for term in terms if (cause := member.cause(term)) is not None]

    def sizes(self, campaigns: Sequence[str], effects: Sequence[str]) -> dict[Quantity, Estimate]:
        """Return what campaigns together tell of effects, those left out that none of them shows."""
        members = self.members_of(campaigns)
        shown = [name for name in effects if any(known_to(member, name, "")[0] for member in members)]
        terms = self._widened(members, [()] * len(members), shown, "")
        fits = [m.sizes(m.fit(mine, robust=False, refine=True)) for m, mine in zip(members, terms, strict=True)]
        groups, _ = contradicting(fits, [member.begun for member in members])
        every = list(enumerate(agreed(fits, groups)))
        # Of campaigns that contradict each other those count that most agree with.
        return {
            quantity: size_of(sizes, quantity)
            for apart in (True, False)
            for n, sizes in every
            for quantity in sizes.of
            if quantity is not None and bool(groups.get((n, quantity), 0)) == apart
        }

    def of_paths(self, twin: MachineTwin) -> tuple[PathMember, SeveralTwin, Callable[[PathMember, Sizes], Sizes]]:
        """Return its tests of a path, the part of the twin that is of them, and what the other fits make of sizes of theirs."""
        members = self.members_of(twin.campaigns)
        at = next(n for n, member in enumerate(members) if isinstance(member, PathMember))
        others = [
            None if n == at else m.sizes(m.fit(mine, robust=False, refine=True))
            for n, (m, mine) in enumerate(zip(members, _terms(twin), strict=True))
        ]

        def agree(rest: PathMember, sizes: Sizes) -> Sizes:
            alone = [sizes if other is None else other for other in others]
            begun = [rest.begun if n == at else member.begun for n, member in enumerate(members)]
            return agreed(alone, contradicting(alone, begun)[0])[at]

        return cast("PathMember", members[at]), cast("SeveralTwin", twin.members[at]), agree

    def newest(self, name: str, version: int | None = None) -> MachineTwin:
        """Return a version of a twin, the newest one without a number."""
        document, path = self.newest_document(name, version)
        try:
            if document["format"] != FORMAT:
                raise ValueError(f"format {document['format']}")
            return self._twin(document)
        except (KeyError, TypeError, ValueError) as error:
            raise unknown_form("a twin of several kinds", str(path), FORMAT, error) from error

    def _twin(self, document: Mapping[str, Any]) -> MachineTwin:
        shelves = {one["kind"]: self._shelf(one["kind"]) for one in document["campaigns"]}
        by_kind = {shelf.kind: shelf for shelf in shelves.values()}
        twin = MachineTwin(
            name=document["twin"],
            members=tuple(by_kind[one.get("kind", PATHS)].stored(one) for one in document["members"]),
            labels=tuple(effect["label"] for effect in document["effects"]),
            contradictions=contradictions_from(document),
            document=document,
            **{key: document[key] for key in ("version", "machine", "campaign", "action", "figures")},
        )
        told: tuple[Contradiction, ...] = recorded(self.home, twin.machine, twin.begun, twin.contradictions)
        return replace(twin, contradictions=told)

    def _shelf(self, kind: str) -> Any:
        """Return the twins of one kind of campaign."""
        return kind_named(kind).twins(self.home, self._library)

    def members_of(self, campaigns: Sequence[str]) -> list[Member]:
        """Return campaigns by the fits that take them, in the order in which they are named."""
        lake = Lake(self.home.lake)
        shelves: dict[str, tuple[HasMembers, list[str]]] = {}
        for campaign in campaigns:
            kind = lake.campaign(campaign).kind
            shelf = self._shelf(kind)
            if not isinstance(shelf, HasMembers):
                raise InputError(
                    "twins of this kind of campaign take no part in one of several",
                    code="twin.not_together",
                    where=campaign,
                    got=kind,
                    hint=f"dtwin twin fit {campaign} fits it alone",
                )
            shelves.setdefault(shelf.kind, (shelf, []))[1].append(campaign)
        return [member for shelf, names in shelves.values() for member in shelf.members(names)]

    def _widened(self, members: Sequence[Member], terms: _Terms, names: Sequence[str], axis: str) -> _Terms:
        """Return terms with effects by name, each in all campaigns that show its cause."""
        more: list[list[Any]] = [[] for _ in members]
        for name in names:
            told = [known_to(member, name, axis) for member in members]
            if not any(known for known, _ in told):
                raise _unknown(name, axis, members, [refused for _, refused in told if refused is not None])
            for mine, (known, _) in zip(more, told, strict=True):
                mine += known
        # All at once: time constants are found beside what else is named.
        return widened(members, terms, more)

    def _without(self, members: Sequence[Member], terms: _Terms, name: str, axis: str) -> _Terms:
        """Return terms without an effect, in all campaigns that show its cause."""
        gone = [known_to(member, name, axis)[0] for member in members]
        causes = {c for m, mine in zip(members, gone, strict=True) for t in mine if (c := m.cause(t)) is not None}
        return [
            [t for t in member.without(mine, out) if member.cause(t) not in causes]
            for member, mine, out in zip(members, terms, gone, strict=True)
        ]

    def _idle(self, twin: MachineTwin, said: MachineDiagnosis) -> str:
        """Return the first effect that pays nothing where it shows; none that several campaigns share."""
        alone = {name for e in twin.document["effects"] if len(e["campaigns"]) == 1 for name in e["names"]}
        return next((label for told in said.told for label in told.idle if label in alone), "")

    def _diagnosed(self, twin: MachineTwin, members: Sequence[Member], seed: int) -> MachineDiagnosis:
        for member in members:
            require_same_machine(twin.name, twin.machine, ", ".join(member.campaigns), member.machine)
        path = self.newest_document(twin.name, twin.version)[1]
        check_sums = [self._made_from(path, member, seed) for member in members]
        if kept := kept_document(path, check_sums):
            return MachineDiagnosis(twin, tuple(members), tuple(map(told_from, kept["members"], kept["told"])))
        told = [member.told(part, seed) for member, part in zip(members, twin.members, strict=True)]
        said = MachineDiagnosis(twin, tuple(members), tuple(told))
        named = {"twin": twin.name, "version": twin.version, "campaign": twin.campaign}
        groups = [{"found": one.found, "surely": one.surely, "idle": one.idle} for one in told]
        self.store_diagnosis({**named, MADE_FROM: check_sums, "told": groups, **said.as_dict()})
        return said

    def _made_from(self, path: Path, member: Member, seed: int) -> str:
        """Return a check sum of all that the diagnosis of a fit depends on; empty where nobody knows."""
        if isinstance(member, PathMember):
            return member.made_from(path, seed)
        lake = Lake(self.home.lake)
        return made_from_rows(path, [row for name in member.campaigns for row in lake.runs(name)], seed)

    def _of(self, name: str, members: Sequence[Member], action: str) -> Version:
        return Version(name, self.next_version(name, members[0].machine), action)

    def _after(self, twin: MachineTwin, action: str) -> Version:
        return Version(twin.name, self.next_version(twin.name, twin.machine, twin.version), action)

    def _store(self, of: Version, members: Sequence[Member], terms: _Terms, *, ahead: bool = False) -> MachineTwin:
        twin = self._made(of, members, terms)
        self.store(twin.as_dict(), ahead=ahead)
        return twin

    def _made(self, of: Version, members: Sequence[Member], terms: _Terms, *, robust: bool = False) -> MachineTwin:
        """Fit each kind by itself, and let the fits agree on what they share."""
        fits = [m.fit(mine, robust=robust, refine=True) for m, mine in zip(members, terms, strict=True)]
        alone = [member.sizes(one) for member, one in zip(members, fits, strict=True)]
        groups, apart = contradicting(alone, [member.begun for member in members])
        together = agreed(alone, groups)
        twins = [m.twin(one, sizes, of) for m, one, sizes in zip(members, fits, together, strict=True)]
        entries = [entry for m, twin in zip(members, twins, strict=True) for entry in m.entries(twin)]
        within = [one for twin in twins for one in getattr(twin, "contradictions", ())]
        document = {
            "format": FORMAT,
            "kind": MACHINE,
            "twin": of.name,
            "version": of.version,
            "machine": members[0].machine,
            "campaign": ", ".join(one["campaign"] for one in entries),
            "action": of.action,
            "effects": effects_of(members, terms),
            "shared": shared_of(members, alone, together, groups),
            "parameters": [
                {**parameter, "campaigns": list(member.campaigns)}
                for member, twin in zip(members, twins, strict=True)
                for parameter in twin.as_dict()["parameters"]
            ],
            "figures": figures_of(entries),
            "campaigns": entries,
            "members": [twin.as_dict() for twin in twins],
            "contradictions": [one.as_dict() for one in (*within, *apart)],
            "data": {name: value for twin in twins for name, value in twin.as_dict()["data"].items()},
            "replication": REPLICATION,
        }
        return self._twin(document)


def _terms(twin: MachineTwin) -> _Terms:
    return [part.terms for part in twin.members]


def _fresh(members: Sequence[Member], old: _Terms, new: _Terms) -> list[str]:
    """Return what is new, as a user writes it, each cause once."""
    before = {label for m, mine in zip(members, old, strict=True) for label in map(m.label, mine)}
    fresh = [[t for t in mine if m.label(t) not in before] for m, mine in zip(members, new, strict=True)]
    return [entry["label"] for entry in effects_of(members, fresh)]


def _added(members: Sequence[Member], old: _Terms, new: _Terms) -> str:
    return f"add {', '.join(_fresh(members, old, new))}"


def _denied(new: MachineTwin, old: MachineTwin) -> bool:
    """Tell whether all that is new shows in several campaigns, and is not there by all of them together."""
    fresh = [one for one in new.document["effects"] if one["label"] not in old.labels]
    before = {(one["effect"], one["axis"]) for one in old.document["shared"]}
    shared = [one for one in new.document["shared"] if (one["effect"], one["axis"]) not in before]
    if len({(one["effect"], one["axis"]) for one in shared}) < len(fresh):
        return False
    return all(one["value"] is not None and abs(one["value"]) <= _THERE * one["uncertainty"] for one in shared)


def _unknown(name: str, axis: str, members: Sequence[Member], refused: Sequence[InputError]) -> InputError:
    """Return the refusal of an effect that no campaign has; of a place where it cannot act, if some campaign knows the name."""
    placed = next((one for one in refused if one.code != "effect.unknown"), None)
    names = dict.fromkeys(known for one in refused for known in (one.allowed or "").partition(";")[0].split(", "))
    return placed or InputError(
        "none of these campaigns has such an effect",
        code="effect.unknown",
        where=", ".join(campaign for member in members for campaign in member.campaigns),
        got=name[:60],
        allowed=", ".join(names),
        hint="dtwin effects list",
    )
