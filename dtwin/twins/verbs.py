"""Twins of a lake's campaigns: fit, compare, diagnose, add, remove, discover, history."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import datetime, timedelta
from functools import cached_property
from typing import IO, Any

from dtwin.acquire.campaign_name import in_lake
from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.lake.store import Lake
from dtwin.locks import take
from dtwin.physics import localise
from dtwin.physics.budget import Budget
from dtwin.physics.diagnose import diagnose
from dtwin.physics.diagnosis import Diagnosis, Suspect
from dtwin.physics.effect import Effect
from dtwin.physics.experiment import next_experiment
from dtwin.physics.fit import fit
from dtwin.physics.library import Library
from dtwin.physics.machine_terms import key_of, machine_terms
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Term
from dtwin.physics.several_diagnosis import diagnose_several
from dtwin.physics.several_twin import SeveralTwin, seen_in
from dtwin.physics.twin import Twin, chosen_terms, data_lines, frozen_residual_um, twin_of
from dtwin.physics.undecided import like_repeats, undecided
from dtwin.processes import give_back_memory
from dtwin.progress import tell
from dtwin.schema import require_name
from dtwin.twins._kept_diagnosis import (
    ALONE,
    MADE_FROM,
    is_built_in,
    kept_alone,
    kept_diagnosis,
    kept_several,
    made_from,
    made_from_several,
    with_record,
)
from dtwin.twins._learned import WithLearned, twin_from
from dtwin.twins._path_member import PathMember
from dtwin.twins.budget_spread import BudgetSpread, spread_budget
from dtwin.twins.measured import Comparison, Loaded, common_temperatures, from_temperatures, load, rises_from_one
from dtwin.twins.several_campaigns import SeveralComparison, fitted_together, require_together
from dtwin.twins.shelf import PATHS, TwinShelf, effect_absent, effect_there, logged_together, require_same_machine

_MOST_RUNGS = 40
_PATIENCE_S, _LOOK_EVERY_S = 600.0, 0.05


class Twins(TwinShelf):
    """The twins of a home that are of tests of a path.

    Args:
        library: Effects; the built-in ones and those of entry points without.
    """

    def __init__(self, home: Home, library: Mapping[str, Effect] | None = None) -> None:
        super().__init__(home, PATHS)
        self._others = library

    @cached_property
    def library(self) -> WithLearned:
        """Effects, and what was learned beside them; looking for those of entry points takes longer than a page may."""
        others = Library() if self._others is None else self._others
        return WithLearned(others, self.home.root / "formulas")

    def fit(self, campaign: str | Sequence[str], effects: Sequence[str], name: str, *, robust: bool = False) -> Twin:
        """Fit a twin to campaigns of a machine; an existing twin of that name gets a new version.

        Args:
            campaign: Name in the lake, or a file or folder; several are fitted together.
            effects: Names; ``name:axis`` takes one axis.
            robust: Give runs that are far off less weight.

        Raises:
            InputError: When campaigns are of several machines, or cannot have a twin together.
        """
        require_name(name, "the twin")
        names = [campaign] if isinstance(campaign, str) else list(campaign)
        loaded = self._load(names)
        return self._store(name, loaded, self._terms(effects, loaded), "fit", robust=robust)

    def compare(self, name: str, campaign: str | None = None) -> Comparison | SeveralComparison:
        """Compare a twin with measurements.

        Args:
            campaign: Other measurements than those of the fit, or one of several campaigns.

        Raises:
            InputError: When the campaign is of another machine.
        """
        twin = self.newest(name)
        if isinstance(twin, SeveralTwin) and campaign is None:
            loaded = self._load(twin.campaigns)
            return SeveralComparison(twin, tuple(self.compared(twin, one) for one in loaded))
        return self.against(twin, campaign or twin.campaign)

    def compared(self, twin: Twin, loaded: Loaded) -> Comparison:
        """Compare a twin with one campaign."""
        obs = self._seen_by(twin, loaded.obs)
        require_same_machine(twin.name, twin.machine, obs.campaign.name, obs.campaign.machine)
        warnings = data_lines(loaded.data)
        if isinstance(twin, SeveralTwin):
            twin, absent = seen_in(twin, obs, self.library)
            warnings += [f"not compared, for its phase or size there is not known: {label}" for label in absent]
        outside = twin.box.outside(obs)
        if outside:
            shown = ", ".join(outside[:4]) + (" ..." if len(outside) > 4 else "")
            warnings.append(f"outside the conditions of the fit: {shown}")
        residual = frozen_residual_um(twin, obs)
        before = localise.residual_um(obs, [])
        return Comparison(twin, obs, residual, before, tuple(warnings), loaded.controller_um)

    def budget(self, twin: Twin, campaign: str | None = None) -> tuple[Budget, BudgetSpread]:
        """Return how much each effect of a twin makes of the error, and how sure that is.

        Args:
            campaign: Other measurements than those of the fit; of several campaigns it says which.
        """
        if campaign is None and isinstance(twin, SeveralTwin) and len(twin.parts) > 1:
            raise InputError(
                "the error of which campaign?",
                code="budget.campaign",
                where=f"twin {twin.name}",
                allowed=twin.campaign,
                hint=f"--on {twin.campaigns[0]}",
            )
        obs = self._seen_by(twin, load(self.home, campaign or twin.campaign).obs)
        require_same_machine(twin.name, twin.machine, obs.campaign.name, obs.campaign.machine)
        terms = twin.terms
        if isinstance(twin, SeveralTwin):
            twin, _ = seen_in(twin, obs, self.library)
        return spread_budget(twin, obs, terms)

    def diagnose(self, name: str, *, seed: int = 0) -> tuple[Twin, Diagnosis]:
        """Find out what a twin lacks; what was found out before, of the same version by the same code, is read again."""
        document, path = self.newest_document(name)
        twin = with_record(self.home, twin_from(document, self.library, str(path)))
        loaded = self._load(twin.campaigns)
        for one in loaded:
            require_same_machine(name, twin.machine, one.obs.campaign.name, one.obs.campaign.machine)
        check_sums = [made_from(path, one, self.library, seed) for one in loaded]
        # Another process may be at it, as the one in the background; two would take twice as long. One that hangs is not waited for.
        with path.open() as version:
            _wait_for(version, f"twin {name} version {twin.version}")
            if isinstance(twin, SeveralTwin):
                together = made_from_several(check_sums, twin.contradictions)
                alone = kept_alone(path, check_sums)
                campaigns = [one.obs for one in loaded]
                said = kept_several(path, together, twin, campaigns, alone)
                if said is not None:
                    return twin, said
                several = diagnose_several(twin, campaigns, self.library, seed=seed, alone=alone)
                each = zip(several.tests, check_sums, strict=True)
                about = {MADE_FROM: together, ALONE: [{MADE_FROM: one, **test.found.as_dict()} for test, one in each]}
                return twin, self._keep(twin, several, loaded, about)
            obs, check_sum = loaded[0].obs, check_sums[0]
            kept = kept_diagnosis(path, check_sum)
            if kept is not None:
                return twin, kept
            diagnosis = diagnose(obs, twin.terms, self.library, seed=seed)
            diagnosis = replace(diagnosis, undecided=undecided(like_repeats(obs, diagnosis), twin.terms, self.library))
            diagnosis = replace(diagnosis, next_experiment=next_experiment(obs, twin.terms, diagnosis, self.library))
            return twin, self._keep(twin, diagnosis, loaded, {MADE_FROM: check_sum})

    def _keep(self, twin: Twin, diagnosis: Diagnosis, loaded: Sequence[Loaded], about: Mapping[str, Any]) -> Diagnosis:
        diagnosis = replace(diagnosis, told=tuple(line for one in loaded for line in data_lines(one.data)))
        document = {"twin": twin.name, "version": twin.version, "campaign": twin.campaign, **about}
        self.store_diagnosis(document | diagnosis.as_dict())
        give_back_memory()
        return diagnosis

    def add(self, name: str, effect: str, axis: str = "") -> Twin:
        """Add an effect, refit, and store the new version.

        Args:
            effect: Name of the effect, or ``name:axis``.
            axis: One axis; all on which it can act without.

        Raises:
            InputError: When the twin has it already.
        """
        twin = self.newest(name)
        return self._added(twin, self._load(twin.campaigns), effect, axis)

    def _added(
        self,
        twin: Twin,
        loaded: Sequence[Loaded],
        effect: str,
        axis: str,
        shape: Mapping[str, float] | None = None,
        *,
        refine: bool = True,
        ahead: bool = True,
    ) -> Twin:
        new = [replace(term, shape={**term.shape, **(shape or {})}) for term in self._terms([effect], loaded, axis)]
        # To several campaigns names of one cause are one effect.
        there = {key_of(term) for term in twin.terms} if len(loaded) > 1 else set()
        fresh = [term for term in new if term.label not in twin.labels and key_of(term) not in there]
        if not fresh:
            raise effect_there(twin, effect)
        added = ", ".join(term.label for term in fresh)
        terms = [*twin.terms, *fresh]
        return self._store(twin.name, loaded, terms, f"add {added}", twin.version, refine=refine, ahead=ahead)

    def remove(self, name: str, effect: str, axis: str = "") -> Twin:
        """Take an effect out, refit, and store the new version; it is refused when the twin does not have it."""
        twin = self.newest(name)
        wanted, _, own = effect.partition(":")
        where = own or axis
        kept = [t for t in twin.terms if t.instance.effect.name != wanted or (where and t.instance.axis != where)]
        if len(kept) == len(twin.terms):
            raise effect_absent(twin, effect)
        return self._store(name, self._load(twin.campaigns), kept, f"remove {effect}", twin.version)

    def restore(self, name: str, version: int) -> Twin:
        """Refit with the effects of an older version, and store that as a new one."""
        old = self.newest(name, version)
        return self._store(name, self._load(old.campaigns), old.terms, f"restore v{version}")

    @logged_together
    def discover(self, name: str, *, seed: int = 0) -> tuple[list[Twin], list[tuple[str, ...]], Diagnosis]:
        """Diagnose and add all that was found, until nothing more is found that is clear enough.

        Of what a later round finds, only what :meth:`Diagnosis.to_add` says is added; the rest stays in the last word.

        Returns:
            The versions that were made, one for every effect.
            For each of them the effect and what cannot be told from it.
            The last word.
        """
        made: list[Twin] = []
        groups: list[tuple[str, ...]] = []
        twin, said = self.diagnose(name, seed=seed)
        loaded = self._load(twin.campaigns)
        to_add = _to_add(said.found, said, twin)
        while to_add and len(made) < _MOST_RUNGS:
            for number, (labels, effect, axis, shape) in enumerate(to_add, start=1):
                # The diagnosis refined the shapes of all that it found together: once more is enough.
                last = number == len(to_add)
                twin = self._added(twin, loaded, effect, axis, shape, refine=last, ahead=False)
                made.append(twin)
                groups.append(labels)
            tell(f"{name}: what is left beside {', '.join(twin.labels)}")
            _, said = self.diagnose(name, seed=seed)
            to_add = _to_add(said.to_add(twin.labels, [one.obs for one in loaded]), said, twin)
        return made, groups, said

    def members(self, campaigns: Sequence[str]) -> Sequence[PathMember]:
        """Return campaigns of the lake as a part of a twin of several kinds, all in one fit."""
        return [PathMember(self, rises_from_one([load(self.home, campaign) for campaign in campaigns]))]

    def stored(self, document: Mapping[str, Any]) -> Twin:
        """Return the twin of a document."""
        return twin_from(document, self.library, f"twin {document['twin']}")

    def against(self, twin: Twin, campaign: str) -> Comparison:
        """Compare a twin with measurements."""
        return self.compared(twin, load(self.home, campaign))

    def _seen_by(self, twin: Twin, obs: Observations) -> Observations:
        """Return a campaign with rises of temperature from what the twin was fitted at: growth in between is foretold, too."""
        grows = any(name.endswith("_c") for term in twin.terms for name in term.instance.effect.needs)
        if not grows or twin.campaigns == (obs.campaign.name,):
            return obs
        return from_temperatures(obs, common_temperatures([load(self.home, name).obs for name in twin.campaigns]))

    def newest(self, name: str, version: int | None = None) -> Twin:
        """Return a version of a twin, the newest one without a number; errors as of :meth:`newest_document`."""
        document, path = self.newest_document(name, version)
        return with_record(self.home, twin_from(document, self.library, str(path)))

    def _load(self, campaigns: Sequence[str]) -> list[Loaded]:
        if len(campaigns) > 1:
            names = [in_lake(self.home, campaign) for campaign in campaigns]
            known = [Lake(self.home.lake).campaign(name) for name in names]
            require_together([(c.name, c.machine, c.kind) for c in known])
            return rises_from_one([load(self.home, name) for name in names])
        return [load(self.home, campaign) for campaign in campaigns]

    def _terms(self, effects: Sequence[str], loaded: Sequence[Loaded], axis: str = "") -> list[Term]:
        campaigns = [one.obs for one in loaded]
        if len(campaigns) > 1:
            return machine_terms(effects, self.library, campaigns, axis)
        return chosen_terms(effects, self.library, campaigns[0], axis)

    def _store(
        self,
        name: str,
        loaded: Sequence[Loaded],
        terms: Sequence[Term],
        action: str,
        base: int | None = None,
        *,
        robust: bool = False,
        refine: bool = True,
        ahead: bool = True,
    ) -> Twin:
        version = self.next_version(name, loaded[0].obs.campaign.machine, base)
        if len(loaded) > 1:
            twin: Twin = fitted_together(
                loaded, terms, self.library, name=name, version=version, action=action, robust=robust, refine=refine
            )
        else:
            (one,) = loaded
            fitted = fit(one.obs, terms, robust=robust, refine=refine)
            twin = twin_of(fitted, one.obs, name=name, version=version, action=action, data=one.data)
        self.store(twin.as_dict(), ahead=ahead and is_built_in(self.library))
        return with_record(self.home, twin)


def _wait_for(version: IO[Any], said: str) -> None:
    """Lock the file of a version; while another process has it, say so and wait, for as long as one is waited for."""
    if take(version):
        return
    until = time.monotonic() + _PATIENCE_S
    last = datetime.now().astimezone() + timedelta(seconds=_PATIENCE_S)
    tell(f"{said}: waiting for another process that diagnoses it, until {last:%H:%M:%S} at the latest")
    while not take(version) and time.monotonic() < until:
        time.sleep(_LOOK_EVERY_S)


_Addition = tuple[tuple[str, ...], str, str, Mapping[str, float]]


def _to_add(groups: Sequence[Sequence[Suspect]], said: Diagnosis, twin: Twin) -> list[_Addition]:
    """Return what is added to a twin: labels, effect, axis and shape of the leaders of groups, and of what happens at one place.

    Without that the sizes of the others would have a part of it.
    """
    leaders = [
        (tuple(s.label for s in group), group[0].effect, group[0].axis, group[0].shape or {}) for group in groups
    ]
    places = [((f"{p['effect']} {p['axis']}",), p["effect"], p["axis"], p["shape"]) for p in said.places]
    return [*leaders, *(place for place in places if place[0][0] not in twin.labels)]
