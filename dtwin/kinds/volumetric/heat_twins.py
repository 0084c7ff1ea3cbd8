"""Twins of ball-array campaigns: fit, compare, diagnose, add, remove, discover, history.

The verbs of :class:`dtwin.twins.verbs.Twins`, for errors that heat makes in a volume.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dtwin.kinds.volumetric._chain import COEFFICIENTS, coefficient
from dtwin.kinds.volumetric._data import HeatCampaign
from dtwin.kinds.volumetric._heat_diagnosis import HeatDiagnosis, diagnose_heat
from dtwin.kinds.volumetric._heat_series import HeatSeries
from dtwin.kinds.volumetric.heat_twin import (
    FORMAT,
    KIND,
    HeatTwin,
    by_day,
    fit_heat,
    heat_figures,
    heat_told,
    heat_twin_from,
)
from dtwin.kinds.volumetric.motions import HeatTerm, heat_terms
from dtwin.physics.agreed import Sizes
from dtwin.schema import Floats
from dtwin.twins.members import Cause
from dtwin.twins.shelf import effect_there, logged_together, require_same_machine
from dtwin.twins.term_twins import TermTwins

_MOST_RUNGS = 30


@dataclass(frozen=True)
class HeatComparison:
    """A twin of heat against a campaign. ``left``, shape (cycles, motions): motions less what the twin says of them."""

    twin: HeatTwin
    series: HeatSeries
    left: Floats
    where: tuple[dict[str, Any], ...]
    warnings: tuple[str, ...]

    def as_dict(self, cutoff: object = None) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        figures = heat_figures(self.series, self.left)
        return {
            "kind": KIND,
            "twin": self.twin.name,
            "version": self.twin.version,
            "campaign": self.series.campaign,
            "runs": len(self.series.hour),
            "rms_before_um": figures["rms_before_um"],
            "residual_rms_um": figures["rms_after_um"],
            "systematic_rms_um": figures["systematic_rms_um"],
            "noise_floor_um": figures["noise_floor_um"],
            "replication": "cycle",
            "conditions": list(by_day(self.series, self.left)),
            "motions": self._motions(),
            "where": list(self.where),
            "warnings": list(self.warnings),
            "encoder_split": None,
        }

    def _motions(self) -> list[dict[str, Any]]:
        """Return every motion with what it does at the balls, before and after."""
        series = self.series
        labels = {term.motion: term.label for term in self.twin.terms}
        return [
            {
                "effect": name,
                "in_twin": labels.get(name),
                "rms_before_um": series.share_um(series.values[:, i], i),
                "rms_after_um": series.share_um(self.left[:, i], i),
                "noise_um": series.share_um(series.uncertainty_of(i), i),
            }
            for i, name in enumerate(series.names)
        ]


class HeatTwins(TermTwins[HeatTerm, HeatCampaign, HeatTwin, HeatDiagnosis]):
    """The twins of a home that are of ball arrays.

    Verbs, and what they refuse and return, are those of :class:`dtwin.twins.verbs.Twins`.
    """

    named, form = KIND, FORMAT
    no_robust = "leave out --robust; dtwin check names cycles that went wrong"

    def loaded(self, campaign: str) -> HeatCampaign:
        """Return a campaign; its error motions are identified when its terms are known."""
        return HeatCampaign(self.home, campaign)

    def asked(self, loaded: HeatCampaign, effects: Sequence[str], axis: str) -> Sequence[HeatTerm]:
        """Return error motions or families, as :func:`dtwin.kinds.volumetric.motions.heat_terms` takes them."""
        return heat_terms(effects, axis)

    def label(self, term: HeatTerm) -> str:
        """Return a term as a user writes it."""
        return term.label

    def joined(self, loaded: HeatCampaign, terms: Sequence[HeatTerm], more: Sequence[HeatTerm]) -> Sequence[HeatTerm]:
        """Return terms with others; a motion that is there gets their temperatures, too."""
        there = {term.motion: term for term in terms}
        for term in more:
            old = there.get(term.motion, term)
            # What any thermocouple may drive is not narrowed.
            sources = set(old.sources) | set(term.sources) if old.sources else old.sources
            there[term.motion] = HeatTerm(term.motion, tuple(sorted(sources)))
        return list(there.values())

    def without(self, terms: Sequence[HeatTerm], gone: Sequence[HeatTerm]) -> Sequence[HeatTerm]:
        """Return terms without the motions of others, whatever drives them."""
        out = {term.motion for term in gone}
        return [term for term in terms if term.motion not in out]

    def possible(self, loaded: HeatCampaign) -> Sequence[HeatTerm]:
        """Return the usual error motions."""
        return [HeatTerm(motion) for motion in COEFFICIENTS]

    def cause(self, loaded: HeatCampaign, term: HeatTerm) -> Cause | None:
        """Return the growth of an axis; other motions are of the campaign."""
        what = coefficient(term.motion)
        grows = what.letter == what.axis and what.order == 1
        return ("thermal_growth", what.axis) if grows else None

    def sizes(self, loaded: HeatCampaign, terms: Sequence[HeatTerm]) -> Sizes:
        """Return none: what a kelvin does is of a campaign's own thermocouples, which the fit chooses."""
        return Sizes((), np.zeros(0), np.zeros((0, 0)), np.zeros(0))

    def told(self, loaded: HeatCampaign, terms: Sequence[HeatTerm], sizes: Sizes) -> Mapping[str, Any]:
        """Fit terms, and return what is stored of that."""
        cycles = loaded.cycles(terms)
        return {**heat_told(cycles.series, terms), "data": cycles.data}

    def stored(self, document: Mapping[str, Any]) -> HeatTwin:
        """Return the twin of a document."""
        return heat_twin_from(document)

    def diagnosed(self, loaded: HeatCampaign, terms: Sequence[HeatTerm]) -> HeatDiagnosis:
        """Return what a twin of these terms lacks."""
        cycles = loaded.cycles(terms)
        fitted = fit_heat(cycles.series, terms)
        return diagnose_heat(cycles.series, fitted, cycles.worst_places(cycles.series.values - fitted.expected))

    def groups(self, said: HeatDiagnosis) -> tuple[tuple[str, ...], ...]:
        """Return every addition by itself: motions beside it are missing, too, not instead of it."""
        return tuple((label,) for label in said.additions)

    def against(self, twin: HeatTwin, campaign: str) -> HeatComparison:
        """Compare a version of a twin with measurements.

        Raises ``InputError`` when the campaign is of another machine, or lacks a temperature of the twin.
        """
        loaded = HeatCampaign(self.home, campaign).cycles(twin.terms)
        series = loaded.series
        require_same_machine(twin.name, twin.machine, series.campaign, series.machine)
        left = series.values - twin.expected(series)
        outside = twin.outside(series)
        shown = ", ".join(outside[:4]) + (f" and {len(outside) - 4} more" if outside[4:] else "")
        warnings = (f"beyond what the fit saw: {shown}",) if outside else ()
        return HeatComparison(twin, series, left, loaded.worst_places(left), warnings)

    def add(self, name: str, effect: str, axis: str = "") -> HeatTwin:
        """Add an error motion or a family, refit, and store the new version.

        A motion that the twin has may be driven by more temperatures than before: ``EX0@foundation_c``.
        """
        twin = self.newest(name)
        return self._added(twin, self.loaded(twin.campaign), heat_terms([effect], axis))

    def _added(self, twin: HeatTwin, loaded: HeatCampaign, more: Sequence[HeatTerm]) -> HeatTwin:
        terms = _joined(twin, more)
        action = "add " + ", ".join(term.label for term in terms if term not in twin.terms)
        return self._store(twin.name, loaded, terms, action, twin.version)

    @logged_together
    def discover(self, name: str, *, seed: int = 0) -> tuple[list[HeatTwin], list[tuple[str, ...]], HeatDiagnosis]:
        """Diagnose and add until nothing is missing, or nothing that was logged would help; nothing here is random."""
        twin = self.newest(name)
        loaded = self.loaded(twin.campaign)
        made: list[HeatTwin] = []
        groups: list[tuple[str, ...]] = []
        said = self._diagnosed(twin, loaded)
        while said.additions and len(made) < _MOST_RUNGS:
            twin = self._added(twin, loaded, heat_terms(said.additions[:1]))
            made.append(twin)
            groups.append(said.additions[:1])
            said = self._diagnosed(twin, loaded)
        return made, groups, said

    def counted(self, loaded: HeatCampaign, twin: HeatTwin) -> tuple[int, int]:
        """Return the number of cycles twice: each is a run, and a reading."""
        return (int(twin.figures["n_cycles"]),) * 2


def _joined(twin: HeatTwin, more: Sequence[HeatTerm]) -> tuple[HeatTerm, ...]:
    """Return the terms of a twin with others; a motion that it has gets their temperatures, too."""
    terms = {term.motion: term for term in twin.terms}
    for term in more:
        terms[term.motion] = _widened(terms.get(term.motion), twin, term)
    if tuple(terms.values()) == twin.terms:
        hint = f"another temperature for it: {more[0].motion}@NAME"
        raise effect_there(twin, ", ".join(term.label for term in more), hint)
    return tuple(terms.values())


def _widened(old: HeatTerm | None, twin: HeatTwin, new: HeatTerm) -> HeatTerm:
    if old is None:
        return new
    if not new.sources:
        return old
    known = old.sources or twin.models[twin.terms.index(old)].sensors
    return HeatTerm(new.motion, tuple(sorted({*known, *new.sources})))
