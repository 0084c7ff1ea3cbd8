"""What of a machine's campaigns is fitted by one fit, in a twin of campaigns of several kinds."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from dtwin.errors import InputError
from dtwin.lake.store import Lake
from dtwin.physics.agreed import Sizes

Cause = tuple[str, str]
"""What of the machine an effect measures, and on which axis."""


@dataclass(frozen=True)
class Version:
    """Of which version of which twin something is a part."""

    name: str
    version: int
    action: str


@dataclass(frozen=True)
class Told:
    """What the fit of one kind lacks.

    ``found``: groups of effects as a user writes them, the one to add first, with what cannot be told from it.
    ``surely``: those of them that may be added after another one was. ``idle``: effects that pay nothing.
    """

    result: dict[str, Any]
    found: tuple[tuple[str, ...], ...]
    surely: tuple[tuple[str, ...], ...]
    idle: tuple[str, ...] = ()


def told_from(result: Mapping[str, Any], groups: Mapping[str, Any]) -> Told:
    """Return what was told before, from how it was stored."""
    named, surely = (tuple(map(tuple, groups[name])) for name in ("found", "surely"))
    return Told(dict(result), named, surely, tuple(groups["idle"]))


class Member(ABC):
    """Campaigns of one kind, loaded, in a twin of several kinds.

    ``kind``: of the shelf where a twin of them alone would be.
    ``begun``, (str, str): of each campaign name and day.
    ``machine``: what they were measured on.
    """

    kind: str
    begun: tuple[tuple[str, str], ...]
    machine: str

    @property
    def campaigns(self) -> tuple[str, ...]:
        """Their names."""
        return tuple(name for name, _ in self.begun)

    @abstractmethod
    def named(self, effect: str, axis: str = "") -> Sequence[Any]:
        """Return the terms that a user names. Raises ``InputError`` where these campaigns have no such effect."""

    @abstractmethod
    def of_cause(self, cause: Cause) -> Sequence[Any]:
        """Return the terms by which a cause shows here; none where it does not."""

    @abstractmethod
    def cause(self, term: Any) -> Cause | None:
        """Return the cause of a term; None where it belongs to the campaign."""

    @abstractmethod
    def label(self, term: Any) -> str:
        """Return a term as a user writes it."""

    @abstractmethod
    def joined(self, terms: Sequence[Any], more: Sequence[Any]) -> Sequence[Any]:
        """Return terms with others, each once."""

    @abstractmethod
    def without(self, terms: Sequence[Any], gone: Sequence[Any]) -> Sequence[Any]:
        """Return terms without others."""

    @abstractmethod
    def fit(self, terms: Sequence[Any], *, robust: bool, refine: bool) -> Any:
        """Fit terms to these campaigns alone."""

    @abstractmethod
    def sizes(self, fitted: Any) -> Sizes:
        """Return what such a fit says."""

    @abstractmethod
    def twin(self, fitted: Any, sizes: Sizes, of: Version) -> Any:
        """Return the fit with the sizes that all agree on, as a twin of the kind."""

    @abstractmethod
    def entries(self, twin: Any) -> list[dict[str, Any]]:
        """Return a line for each campaign: ``runs``, ``readings``, RMS before and after, and the floor, in um."""

    @abstractmethod
    def compared(self, twin: Any) -> Any:
        """Compare such a twin with these campaigns."""

    @abstractmethod
    def told(self, twin: Any, seed: int) -> Told:
        """Return what such a twin lacks."""


@runtime_checkable
class HasMembers(Protocol):
    """Twins of one kind that can be part of a twin of several kinds."""

    kind: str

    def members(self, campaigns: Sequence[str]) -> Sequence[Member]:
        """Return campaigns of the lake, those together that one fit takes."""

    def stored(self, document: Mapping[str, Any]) -> Any:
        """Return the twin of a document."""

    def against(self, twin: Any, campaign: str) -> Any:
        """Compare a twin with measurements."""


def day_of(lake: Lake, campaign: str) -> str:
    """Return when the first run of a campaign was begun, empty where no run says it."""
    return min((str(row["started"]) for row in lake.runs(campaign) if row["started"]), default="")


def known_to(member: Member, effect: str, axis: str) -> tuple[Sequence[Any], InputError | None]:
    """Return the terms of a name; where there are none, why."""
    try:
        return member.named(effect, axis), None
    except InputError as refused:
        return (), refused


def widened(
    members: Sequence[Member], terms: Sequence[Sequence[Any]], more: Sequence[Sequence[Any]]
) -> list[Sequence[Any]]:
    """Return the terms of each member with others, and with those by which the causes of all show to it."""
    joined = [m.joined(old, new) for m, old, new in zip(members, terms, more, strict=True)]
    causes = dict.fromkeys(c for m, mine in zip(members, joined, strict=True) for t in mine if (c := m.cause(t)))
    out = []
    for member, mine in zip(members, joined, strict=True):
        there = {member.cause(term) for term in mine}
        lacking = [term for cause in causes if cause not in there for term in member.of_cause(cause)]
        out.append(member.joined(mine, lacking) if lacking else mine)
    return out
