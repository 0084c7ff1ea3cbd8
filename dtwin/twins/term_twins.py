"""Twins that are a list of terms with a size each, fitted to one campaign: the verbs that do not depend on its kind."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, Protocol, Self, TypeVar

from dtwin.config import Home
from dtwin.documents import unknown_form
from dtwin.errors import InputError
from dtwin.lake.store import Lake
from dtwin.physics.agreed import Sizes
from dtwin.schema import require_name
from dtwin.twins.members import Cause, Member, Told, Version, day_of
from dtwin.twins.shelf import TwinShelf, effect_absent, effect_there, require_same_machine


class _Told(Protocol):
    @property
    def additions(self) -> tuple[str, ...]: ...
    def as_dict(self) -> dict[str, Any]: ...


class _Measured(Protocol):
    @property
    def campaign(self) -> str: ...
    @property
    def machine(self) -> str: ...
    @property
    def data(self) -> Mapping[str, Any]: ...


_T = TypeVar("_T")
_L = TypeVar("_L", bound=_Measured)
_D = TypeVar("_D", bound=_Told)
_W = TypeVar("_W", bound="TermTwin[Any]")


@dataclass(frozen=True)
class TermTwin(Generic[_T]):
    """A fitted twin; ``document`` is what is stored of it."""

    name: str
    version: int
    machine: str
    campaign: str
    action: str
    terms: tuple[_T, ...]
    figures: Mapping[str, Any]
    document: Mapping[str, Any]

    @classmethod
    def of(cls, document: Mapping[str, Any], terms: tuple[_T, ...]) -> Self:
        """Return the twin that was stored."""
        head = {key: document[key] for key in ("version", "machine", "campaign", "action", "figures")}
        return cls(name=document["twin"], terms=terms, document=document, **head)

    @property
    def campaigns(self) -> tuple[str, ...]:
        """Campaigns that it was fitted to."""
        return (self.campaign,)

    @property
    def labels(self) -> tuple[str, ...]:
        """Terms as a user writes them."""
        return tuple(effect["label"] for effect in self.document["effects"])

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return dict(self.document)


class TermTwins(TwinShelf, ABC, Generic[_T, _L, _W, _D]):
    """The twins of a home that are of one kind; a kind says what its terms are, and how they are fitted.

    ``named``: the kind; ``form``: of its documents; ``no_robust``: what helps against spoilt readings instead.
    """

    named: ClassVar[str]
    form: ClassVar[str]
    no_robust: ClassVar[str]

    def __init__(self, home: Home, _library: object = None) -> None:
        super().__init__(home, self.named)

    @abstractmethod
    def loaded(self, campaign: str) -> _L:
        """Return a campaign as it is fitted, with its ``machine``, ``campaign`` and ``data``."""

    @abstractmethod
    def asked(self, loaded: _L, effects: Sequence[str], axis: str) -> Sequence[_T]:
        """Return the terms that a user names."""

    @abstractmethod
    def label(self, term: _T) -> str:
        """Return a term as a user writes it."""

    def joined(self, loaded: _L, terms: Sequence[_T], more: Sequence[_T]) -> Sequence[_T]:
        """Return terms with others."""
        return (*terms, *more)

    def same(self, one: _T, other: _T) -> bool:
        """Return whether two terms are one effect."""
        return one == other

    def without(self, terms: Sequence[_T], gone: Sequence[_T]) -> Sequence[_T]:
        """Return terms without others."""
        return [term for term in terms if not any(self.same(term, one) for one in gone)]

    def refound(self, loaded: _L, terms: Sequence[_T]) -> Sequence[_T]:
        """Return terms with the shapes that this campaign alone gives them."""
        return terms

    @abstractmethod
    def diagnosed(self, loaded: _L, terms: Sequence[_T]) -> _D:
        """Return what a twin of these terms lacks."""

    @abstractmethod
    def possible(self, loaded: _L) -> Sequence[_T]:
        """Return every term that a campaign may tell."""

    @abstractmethod
    def cause(self, loaded: _L, term: _T) -> tuple[str, str] | None:
        """Return what of the machine a term measures, and on which axis; None where it belongs to the campaign."""

    @abstractmethod
    def sizes(self, loaded: _L, terms: Sequence[_T]) -> Sizes:
        """Fit terms to a campaign."""

    @abstractmethod
    def told(self, loaded: _L, terms: Sequence[_T], sizes: Sizes) -> Mapping[str, Any]:
        """Return what is stored of a fit: ``effects``, ``parameters``, ``figures`` and what else the kind needs."""

    @abstractmethod
    def against(self, twin: _W, campaign: str) -> Any:
        """Compare a twin with measurements."""

    @abstractmethod
    def discover(self, name: str, /, *, seed: int = 0) -> tuple[list[_W], list[tuple[str, ...]], _D]:
        """Diagnose and add until nothing pays; return the new versions, the groups that were found, and the last diagnosis."""

    @abstractmethod
    def counted(self, loaded: _L, twin: _W) -> tuple[int, int]:
        """Return how many runs and readings of a campaign a twin was fitted to."""

    def groups(self, said: _D) -> tuple[tuple[str, ...], ...]:
        """Return the groups of effects that a diagnosis names, the one to add first."""
        return (said.additions,) if said.additions else ()

    def members(self, campaigns: Sequence[str]) -> Sequence[Member]:
        """Return campaigns of the lake as parts of a twin of several kinds, each by itself."""
        return [_TermMember(self, campaign) for campaign in campaigns]

    @abstractmethod
    def stored(self, document: Mapping[str, Any]) -> _W:
        """Return the twin of a document."""

    def fit(self, campaign: str, effects: Sequence[str], name: str, *, robust: bool = False) -> _W:
        """Fit a twin to a campaign; an existing twin of that name gets a new version.

        Raises ``InputError`` when an effect is not known, or a robust fit is asked for.
        """
        require_name(name, "the twin")
        if robust:
            raise InputError(f"a twin of {self.named} has no robust fit", code="twin.robust", hint=self.no_robust)
        loaded = self.loaded(campaign)
        return self._store(name, loaded, self.joined(loaded, (), self.asked(loaded, effects, "")), "fit")

    def compare(self, name: str, campaign: str | None = None) -> Any:
        """Compare a twin with measurements, those of its fit without a campaign."""
        twin = self.newest(name)
        return self.against(twin, campaign or twin.campaign)

    def diagnose(self, name: str, *, seed: int = 0) -> tuple[_W, _D]:
        """Find out what a twin lacks; nothing here is random."""
        twin = self.newest(name)
        loaded = self.loaded(twin.campaign)
        require_same_machine(name, twin.machine, loaded.campaign, loaded.machine)
        return twin, self._diagnosed(twin, loaded)

    def add(self, name: str, effect: str, axis: str = "") -> _W:
        """Add an effect, of one axis or of all, refit, and store the new version."""
        twin = self.newest(name)
        loaded = self.loaded(twin.campaign)
        more = [t for t in self.asked(loaded, [effect], axis) if not any(self.same(t, old) for old in twin.terms)]
        if not more:
            raise effect_there(twin, effect)
        action = f"add {', '.join(map(self.label, more))}"
        return self._store(name, loaded, self.joined(loaded, twin.terms, more), action, twin.version)

    def remove(self, name: str, effect: str, axis: str = "") -> _W:
        """Take an effect out, of one axis or of all, refit, and store the new version."""
        twin = self.newest(name)
        loaded = self.loaded(twin.campaign)
        kept = self.without(twin.terms, self.asked(loaded, [effect], axis))
        if len(kept) == len(twin.terms):
            raise effect_absent(twin, effect)
        return self._store(name, loaded, kept, f"remove {effect}{f'@{axis}' if axis else ''}", twin.version)

    def restore(self, name: str, version: int) -> _W:
        """Refit with the effects of an older version, and store that as a new one."""
        old = self.newest(name, version)
        return self._store(name, self.loaded(old.campaign), old.terms, f"restore v{version}")

    def newest(self, name: str, version: int | None = None) -> _W:
        """Return a version of a twin, the newest one without a number."""
        document, path = self.newest_document(name, version)
        try:
            if document["format"] != self.form:
                raise ValueError(f"format {document['format']}")
            return self.stored(document)
        except (KeyError, TypeError, ValueError, InputError) as error:
            raise unknown_form(f"a twin of {self.named}", str(path), self.form, error) from error

    def _diagnosed(self, twin: _W, loaded: _L) -> _D:
        diagnosis = self.diagnosed(loaded, twin.terms)
        named = {"twin": twin.name, "version": twin.version, "campaign": twin.campaign}
        self.store_diagnosis({**named, **diagnosis.as_dict()})
        return diagnosis

    def _store(self, name: str, loaded: _L, terms: Sequence[_T], action: str, base: int | None = None) -> _W:
        version = self.next_version(name, loaded.machine, base)
        document = self.made(loaded, terms, self.sizes(loaded, terms), name=name, version=version, action=action)
        self.store(document)
        return self.stored(document)

    def made(
        self, loaded: _L, terms: Sequence[_T], sizes: Sizes, *, name: str, version: int, action: str
    ) -> dict[str, Any]:
        """Return what is stored of a version, with these sizes."""
        head = {"format": self.form, "kind": self.named, "twin": name, "version": version}
        of = {key: getattr(loaded, key) for key in ("machine", "campaign", "data")}
        return {**head, **of, "action": action, **self.told(loaded, terms, sizes)}


class _TermMember(Member):
    """One campaign of a kind whose twins are lists of terms."""

    def __init__(self, twins: TermTwins[Any, Any, Any, Any], campaign: str) -> None:
        self._twins, self._loaded = twins, twins.loaded(campaign)
        self.kind, self.machine = twins.named, self._loaded.machine
        self.begun = ((campaign, day_of(Lake(twins.home.lake), campaign)),)

    def named(self, effect: str, axis: str = "") -> Sequence[Any]:
        return self._twins.asked(self._loaded, [effect], axis)

    def of_cause(self, cause: Cause) -> Sequence[Any]:
        return [term for term in self._twins.possible(self._loaded) if self.cause(term) == cause]

    def cause(self, term: Any) -> Cause | None:
        return self._twins.cause(self._loaded, term)

    def label(self, term: Any) -> str:
        return self._twins.label(term)

    def joined(self, terms: Sequence[Any], more: Sequence[Any]) -> Sequence[Any]:
        fresh: list[Any] = []
        for term in more:
            if not any(self._twins.same(term, old) for old in (*terms, *fresh)):
                fresh.append(term)
        return self._twins.joined(self._loaded, terms, fresh) if fresh else terms

    def without(self, terms: Sequence[Any], gone: Sequence[Any]) -> Sequence[Any]:
        return self._twins.without(terms, gone)

    def fit(self, terms: Sequence[Any], *, robust: bool, refine: bool) -> tuple[Sequence[Any], Sizes]:
        if robust:
            raise InputError(f"{self.campaigns[0]} has no robust fit", code="twin.robust", hint=self._twins.no_robust)
        # Those of a twin are what all agreed on.
        shaped = self._twins.refound(self._loaded, terms)
        return shaped, self._twins.sizes(self._loaded, shaped)

    def sizes(self, fitted: tuple[Sequence[Any], Sizes]) -> Sizes:
        return fitted[1]

    def twin(self, fitted: tuple[Sequence[Any], Sizes], sizes: Sizes, of: Version) -> Any:
        made = self._twins.made(self._loaded, fitted[0], sizes, name=of.name, version=of.version, action=of.action)
        return self._twins.stored(made)

    def entries(self, twin: Any) -> list[dict[str, Any]]:
        ((campaign, day),) = self.begun
        runs, readings = self._twins.counted(self._loaded, twin)
        named = ("rms_before_um", "systematic_rms_um", "noise_floor_um")
        return [
            {
                "campaign": campaign,
                "kind": self.kind,
                "started": day,
                "runs": runs,
                "readings": readings,
                "residual_rms_um": twin.figures["rms_after_um"],
                **{name: twin.figures[name] for name in named if name in twin.figures},
            }
        ]

    def compared(self, twin: Any) -> Any:
        return self._twins.against(twin, self.campaigns[0])

    def told(self, twin: Any, seed: int) -> Told:
        said = self._twins.diagnosed(self._loaded, twin.terms)
        groups = self._twins.groups(said)
        return Told(said.as_dict(), groups, groups, tuple(self.label(term) for term in said.idle))
