"""Tests of a path in a twin of several kinds: one least squares over all of them, and what others say of the same machine."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dtwin.physics.agreed import Sizes
from dtwin.physics.contradictions import Contradiction, without_contradictions
from dtwin.physics.gridding import Indices
from dtwin.physics.machine_terms import cause_of, key_of, machine_terms
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Term
from dtwin.physics.several import SeveralFit, fit_several
from dtwin.physics.several_diagnosis import diagnose_several
from dtwin.physics.several_sizes import sizes_of, with_sizes
from dtwin.physics.several_twin import SeveralTwin, several_twin_of, started_of
from dtwin.twins._kept_diagnosis import made_from
from dtwin.twins.measured import Loaded
from dtwin.twins.members import Cause, Member, Told, Version, known_to
from dtwin.twins.several_campaigns import SeveralComparison
from dtwin.twins.shelf import PATHS

if TYPE_CHECKING:
    from dtwin.twins.verbs import Twins

_Fitted = tuple[SeveralFit, tuple[Contradiction, ...]]


class PathMember(Member):
    """All tests of a path of a machine."""

    kind = PATHS

    def __init__(self, twins: Twins, loaded: Sequence[Loaded]) -> None:
        self._twins, self._loaded = twins, loaded
        self.library = twins.library
        self.observations = [one.obs for one in loaded]
        self.machine = self.observations[0].campaign.machine
        self.begun = tuple((obs.campaign.name, started_of(obs)) for obs in self.observations)

    def only(self, rows: Callable[[Observations], Indices]) -> PathMember | None:
        """Return some rows of each campaign; None when none is left."""
        chosen = ((one, rows(one.obs)) for one in self._loaded)
        kept = [replace(one, obs=one.obs.take(own)) for one, own in chosen if len(own)]
        return PathMember(self._twins, kept) if kept else None

    def made_from(self, path: Path, seed: int) -> str:
        """Return a check sum of all that a diagnosis of these tests depends on; empty with effects of others."""
        sums = [made_from(path, one, self.library, seed) for one in self._loaded]
        return " ".join(sums) if all(sums) else ""

    def named(self, effect: str, axis: str = "") -> Sequence[Term]:
        return machine_terms([effect], self.library, self.observations, axis)

    def of_cause(self, cause: Cause) -> Sequence[Term]:
        names = [name for name, effect in self.library.items() if cause_of(effect) == cause[0]]
        for name in names:
            terms, _ = known_to(self, name, cause[1])
            if terms:
                return [term for term in terms if key_of(term) == cause]
        return ()

    def cause(self, term: Term) -> Cause:
        return key_of(term)

    def label(self, term: Term) -> str:
        return term.label.replace(" ", ":")

    def joined(self, terms: Sequence[Term], more: Sequence[Term]) -> Sequence[Term]:
        there = {key_of(term): term for term in reversed([*terms, *more])}
        return [there[key] for key in dict.fromkeys(map(key_of, [*terms, *more]))]

    def without(self, terms: Sequence[Term], gone: Sequence[Term]) -> Sequence[Term]:
        out = {key_of(term) for term in gone}
        return [term for term in terms if key_of(term) not in out]

    def fit(self, terms: Sequence[Term], *, robust: bool, refine: bool) -> _Fitted:
        together = fit_several(self.observations, terms, self.library, robust=robust, refine=refine)
        return without_contradictions(together, [day for _, day in self.begun])

    def sizes(self, fitted: _Fitted) -> Sizes:
        return sizes_of(fitted[0])

    def twin(self, fitted: _Fitted, sizes: Sizes, of: Version) -> SeveralTwin:
        data = [one.data for one in self._loaded]
        together, apart = with_sizes(fitted[0], sizes), fitted[1]
        return several_twin_of(
            together, apart, self.observations, name=of.name, version=of.version, action=of.action, data=data
        )

    def entries(self, twin: SeveralTwin) -> list[dict[str, Any]]:
        told = twin.as_dict()["campaigns"]
        readings = [int(obs.mask.sum()) for obs in self.observations]
        return [
            {name: value for name, value in one.items() if name != "part"} | {"readings": many}
            for one, many in zip(told, readings, strict=True)
        ]

    def compared(self, twin: SeveralTwin) -> SeveralComparison:
        return SeveralComparison(twin, tuple(self._twins.compared(twin, one) for one in self._loaded))

    def told(self, twin: SeveralTwin, seed: int) -> Told:
        said = diagnose_several(twin, self.observations, self.library, seed=seed)
        named, surely = (
            tuple(tuple(f"{s.effect}:{s.axis}".rstrip(":") for s in group) for group in groups)
            for groups in (said.found, said.to_add(twin.labels, self.observations))
        )
        return Told(said.as_dict(), named, surely)
