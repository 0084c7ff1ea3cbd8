"""A ball-array campaign in a twin of several kinds: the growth of an axis has one name, and a size for each thermometer."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from dtwin.errors import InputError
from dtwin.kinds.volumetric._chain import COEFFICIENTS, coefficient
from dtwin.kinds.volumetric._data import HeatLoaded, load_heat
from dtwin.kinds.volumetric._heat_diagnosis import diagnose_heat
from dtwin.kinds.volumetric.heat_twin import HeatFit, HeatTwin, fit_heat, heat_twin_of
from dtwin.kinds.volumetric.motions import HeatTerm, heat_terms
from dtwin.lake.store import Lake
from dtwin.physics.agreed import Sizes
from dtwin.twins.members import Cause, Member, Told, Version, day_of

if TYPE_CHECKING:
    from dtwin.kinds.volumetric.heat_twins import HeatComparison, HeatTwins

_Fitted = tuple[HeatLoaded, Sequence[HeatTerm], HeatFit]


class HeatMember(Member):
    """One campaign. What a kelvin does is of its own thermocouples, which the fit chooses."""

    def __init__(self, twins: HeatTwins, campaign: str) -> None:
        self._twins, self.kind = twins, twins.kind
        lake = Lake(twins.home.lake)
        self.begun = ((campaign, day_of(lake, campaign)),)
        self.machine = lake.campaign(campaign).machine

    def named(self, effect: str, axis: str = "") -> Sequence[HeatTerm]:
        return heat_terms([effect], axis)

    def of_cause(self, cause: Cause) -> Sequence[HeatTerm]:
        return [term for motion in COEFFICIENTS if self.cause(term := HeatTerm(motion)) == cause]

    def cause(self, term: HeatTerm) -> Cause | None:
        what = coefficient(term.motion)
        grows = what.letter == what.axis and what.order == 1
        return ("thermal_growth", what.axis) if grows else None

    def label(self, term: HeatTerm) -> str:
        return term.label

    def joined(self, terms: Sequence[HeatTerm], more: Sequence[HeatTerm]) -> Sequence[HeatTerm]:
        there = {term.motion: term for term in terms}
        for term in more:
            old = there.get(term.motion, term)
            # What any thermocouple may drive is not narrowed.
            sources = set(old.sources) | set(term.sources) if old.sources else old.sources
            there[term.motion] = HeatTerm(term.motion, tuple(sorted(sources)))
        return list(there.values())

    def without(self, terms: Sequence[HeatTerm], gone: Sequence[HeatTerm]) -> Sequence[HeatTerm]:
        out = {term.motion for term in gone}
        return [term for term in terms if term.motion not in out]

    def fit(self, terms: Sequence[HeatTerm], *, robust: bool, refine: bool) -> _Fitted:
        if robust:
            raise InputError(
                f"{self.campaigns[0]} has no robust fit",
                code="twin.robust",
                hint="dtwin check names cycles that went wrong",
            )
        loaded = self._loaded(terms)
        return loaded, terms, fit_heat(loaded.series, terms)

    def sizes(self, fitted: _Fitted) -> Sizes:
        return Sizes((), np.zeros(0), np.zeros((0, 0)), np.zeros(0))

    def twin(self, fitted: _Fitted, sizes: Sizes, of: Version) -> HeatTwin:
        loaded, terms, made = fitted
        about = {"name": of.name, "action": of.action}
        return heat_twin_of(made, loaded.series, terms, version=of.version, data=loaded.data, **about)

    def entries(self, twin: HeatTwin) -> list[dict[str, Any]]:
        ((campaign, day),), figures = self.begun, twin.figures
        told = {name: figures[name] for name in ("rms_before_um", "systematic_rms_um", "noise_floor_um")}
        many = int(figures["n_cycles"])
        about = {"campaign": campaign, "kind": self.kind, "started": day, "runs": many, "readings": many}
        return [{**about, **told, "residual_rms_um": figures["rms_after_um"]}]

    def compared(self, twin: HeatTwin) -> HeatComparison:
        return self._twins.against(twin, self.campaigns[0])

    def told(self, twin: HeatTwin, seed: int) -> Told:
        loaded = self._loaded(twin.terms)
        fitted = fit_heat(loaded.series, twin.terms)
        said = diagnose_heat(loaded.series, fitted, loaded.worst_places(loaded.series.values - fitted.expected))
        groups = tuple((label,) for label in said.additions)
        return Told(said.as_dict(), groups, groups)

    def _loaded(self, terms: Sequence[HeatTerm]) -> HeatLoaded:
        return load_heat(self._twins.home, self.campaigns[0], [term.motion for term in terms])
