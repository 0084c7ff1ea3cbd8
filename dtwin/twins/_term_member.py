"""A campaign of terms with a size each, in a twin of several kinds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from dtwin.errors import InputError
from dtwin.lake.store import Lake
from dtwin.physics.agreed import Sizes
from dtwin.twins.members import Cause, Member, Told, Version, day_of

if TYPE_CHECKING:
    from dtwin.twins.term_twins import TermTwins


class TermMember(Member):
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
        return [term for term in terms if not any(self._twins.same(term, one) for one in gone)]

    def fit(self, terms: Sequence[Any], *, robust: bool, refine: bool) -> tuple[Sequence[Any], Sizes]:
        if robust:
            raise InputError(f"{self.campaigns[0]} has no robust fit", code="twin.robust", hint=self._twins.no_robust)
        # Those of a twin are what all agreed on.
        found = self._twins.refound(self._loaded, terms)
        return found, self._twins.sizes(self._loaded, found)

    def sizes(self, fitted: tuple[Sequence[Any], Sizes]) -> Sizes:
        return fitted[1]

    def twin(self, fitted: tuple[Sequence[Any], Sizes], sizes: Sizes, of: Version) -> Any:
        made = self._twins.made(self._loaded, fitted[0], sizes, name=of.name, version=of.version, action=of.action)
        return self._twins.stored(made)

    def entries(self, twin: Any) -> list[dict[str, Any]]:
        ((campaign, day),) = self.begun
        readings = self._twins.readings(self._loaded)
        figures = twin.figures
        return [
            {
                "campaign": campaign,
                "kind": self.kind,
                "started": day,
                "runs": 1,
                "readings": readings,
                "rms_before_um": figures["rms_before_um"],
                "residual_rms_um": figures["rms_after_um"],
                "noise_floor_um": figures["noise_floor_um"],
            }
        ]

    def compared(self, twin: Any) -> Any:
        return self._twins.against(twin, self.campaigns[0])

    def told(self, twin: Any, seed: int) -> Told:
        said = self._twins.diagnosed(self._loaded, twin.terms)
        group = (said.additions,) if said.additions else ()
        return Told(said.as_dict(), group, group, tuple(self.label(term) for term in said.idle))
