"""Twins of ball-array campaigns: fit, compare, diagnose, add, remove, discover, history.

The verbs of :class:`dtwin.twins.verbs.Twins`, for errors that heat makes in a volume.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from dtwin.config import Home
from dtwin.documents import unknown_form
from dtwin.errors import InputError
from dtwin.kinds.volumetric._data import HeatLoaded, HeatMember, load_heat
from dtwin.kinds.volumetric._heat_diagnosis import HeatDiagnosis, diagnose_heat
from dtwin.kinds.volumetric._heat_series import HeatSeries
from dtwin.kinds.volumetric.heat_twin import (
    FORMAT,
    KIND,
    HeatTwin,
    by_day,
    fit_heat,
    heat_figures,
    heat_twin_from,
    heat_twin_of,
)
from dtwin.kinds.volumetric.motions import HeatTerm, heat_terms
from dtwin.schema import Floats, require_name
from dtwin.twins.shelf import TwinShelf, effect_absent, effect_there, logged_together, require_same_machine

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


class HeatTwins(TwinShelf):
    """The twins of a home that are of ball arrays.

    Verbs, and what they refuse and return, are those of :class:`dtwin.twins.verbs.Twins`.
    """

    def __init__(self, home: Home, _library: object = None) -> None:
        super().__init__(home, KIND)

    def fit(self, campaign: str, effects: Sequence[str], name: str, *, robust: bool = False) -> HeatTwin:
        """Fit a twin to a campaign; an existing twin of that name gets a new version.

        ``effects``: error motions or families, as :func:`dtwin.kinds.volumetric.motions.heat_terms` takes them.
        Raises ``InputError`` when something is not known, or a robust fit is asked for.
        """
        require_name(name, "the twin")
        if robust:
            raise InputError(
                "a twin of heat has no robust fit",
                code="twin.robust",
                where=f"twin {name}",
                hint="leave out --robust; dtwin check names cycles that went wrong",
            )
        terms = heat_terms(effects)
        loaded = load_heat(self.home, campaign, [term.motion for term in terms])
        return self._store(name, loaded, terms, "fit")

    def compare(self, name: str, campaign: str | None = None) -> HeatComparison:
        """Compare a twin with measurements, those of its fit without a campaign.

        Raises ``InputError`` when the campaign is of another machine, or lacks a temperature of the twin.
        """
        twin = self.newest(name)
        return self.against(twin, campaign or twin.campaign)

    def against(self, twin: HeatTwin, campaign: str) -> HeatComparison:
        """Compare a version of a twin with measurements."""
        loaded = self._loaded(twin, campaign)
        series = loaded.series
        require_same_machine(twin.name, twin.machine, series.campaign, series.machine)
        left = series.values - twin.expected(series)
        outside = twin.outside(series)
        shown = ", ".join(outside[:4]) + (f" and {len(outside) - 4} more" if outside[4:] else "")
        warnings = (f"beyond what the fit saw: {shown}",) if outside else ()
        return HeatComparison(twin, series, left, loaded.worst_places(left), warnings)

    def members(self, campaigns: Sequence[str]) -> Sequence[HeatMember]:
        """Return campaigns of the lake as parts of a twin of several kinds, each by itself."""
        return [HeatMember(self, campaign) for campaign in campaigns]

    def stored(self, document: Mapping[str, Any]) -> HeatTwin:
        """Return the twin of a document."""
        return heat_twin_from(document)

    def diagnose(self, name: str, *, seed: int = 0) -> tuple[HeatTwin, HeatDiagnosis]:
        """Find out what a twin lacks; nothing here is random."""
        twin, loaded = self.newest(name), self._loaded(self.newest(name))
        require_same_machine(name, twin.machine, loaded.series.campaign, loaded.series.machine)
        return twin, self._diagnosed(twin, loaded)

    def add(self, name: str, effect: str, axis: str = "") -> HeatTwin:
        """Add an error motion or a family, refit, and store the new version.

        A motion that the twin has may be driven by more temperatures than before: ``EX0@foundation_c``.
        """
        twin = self.newest(name)
        terms = _joined(twin, heat_terms([effect], axis))
        loaded = load_heat(self.home, twin.campaign, [term.motion for term in terms])
        return self._store(name, loaded, terms, _added(twin, terms), twin.version)

    def remove(self, name: str, effect: str, axis: str = "") -> HeatTwin:
        """Take an error motion or a family out, whatever drives it, refit, and store the new version."""
        twin = self.newest(name)
        gone = {term.motion for term in heat_terms([effect], axis)}
        kept = tuple(term for term in twin.terms if term.motion not in gone)
        if len(kept) == len(twin.terms):
            raise effect_absent(twin, effect)
        return self._store(name, self._loaded(twin), kept, f"remove {effect}", twin.version)

    def restore(self, name: str, version: int) -> HeatTwin:
        """Refit with the effects of an older version, and store that as a new one."""
        old = self.newest(name, version)
        return self._store(name, self._loaded(old), old.terms, f"restore v{version}")

    @logged_together
    def discover(self, name: str, *, seed: int = 0) -> tuple[list[HeatTwin], list[tuple[str, ...]], HeatDiagnosis]:
        """Diagnose and add until nothing is missing, or nothing that was logged would help; nothing here is random."""
        twin = self.newest(name)
        loaded = self._loaded(twin)
        made: list[HeatTwin] = []
        groups: list[tuple[str, ...]] = []
        said = self._diagnosed(twin, loaded)
        while said.additions and len(made) < _MOST_RUNGS:
            terms = _joined(twin, heat_terms(said.additions[:1]))
            twin = self._store(name, loaded, terms, _added(twin, terms), twin.version)
            made.append(twin)
            # Motions beside it are missing, too, not instead of it: each is added in its turn.
            groups.append(said.additions[:1])
            said = self._diagnosed(twin, loaded)
        return made, groups, said

    def newest(self, name: str, version: int | None = None) -> HeatTwin:
        """Return a version of a twin, the newest one without a number."""
        document, path = self.newest_document(name, version)
        try:
            if document["format"] != FORMAT:
                raise ValueError(f"format {document['format']}")
            return heat_twin_from(document)
        except (KeyError, TypeError, ValueError, InputError) as error:
            raise unknown_form("a twin of heat", str(path), FORMAT, error) from error

    def _loaded(self, twin: HeatTwin, campaign: str | None = None) -> HeatLoaded:
        return load_heat(self.home, campaign or twin.campaign, [term.motion for term in twin.terms])

    def _diagnosed(self, twin: HeatTwin, loaded: HeatLoaded) -> HeatDiagnosis:
        series = loaded.series
        fitted = fit_heat(series, twin.terms)
        places = loaded.worst_places(series.values - fitted.expected)
        diagnosis = diagnose_heat(series, fitted, places)
        named = {"twin": twin.name, "version": twin.version, "campaign": twin.campaign}
        self.store_diagnosis({**named, **diagnosis.as_dict()})
        return diagnosis

    def _store(
        self, name: str, loaded: HeatLoaded, terms: Sequence[HeatTerm], action: str, base: int | None = None
    ) -> HeatTwin:
        version = self.next_version(name, loaded.series.machine, base)
        fitted = fit_heat(loaded.series, terms)
        twin = heat_twin_of(fitted, loaded.series, terms, name=name, version=version, action=action, data=loaded.data)
        self.store(twin.as_dict())
        return twin


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


def _added(twin: HeatTwin, terms: Sequence[HeatTerm]) -> str:
    return "add " + ", ".join(term.label for term in terms if term not in twin.terms)
