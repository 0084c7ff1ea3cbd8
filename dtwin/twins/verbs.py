"""Twins of a lake's campaigns: fit, compare, diagnose, add, remove, discover, history."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from dtwin.config import Home
from dtwin.physics import localise
from dtwin.physics.budget import Budget, budget
from dtwin.physics.diagnose import diagnose
from dtwin.physics.diagnosis import Diagnosis
from dtwin.physics.effect import Effect
from dtwin.physics.experiment import next_experiment
from dtwin.physics.fit import fit
from dtwin.physics.library import Library
from dtwin.physics.problem import Term
from dtwin.physics.twin import Twin, chosen_terms, data_lines, frozen_residual_um, twin_of
from dtwin.schema import require_name
from dtwin.train.residual_formula import ResidualFormula
from dtwin.train.symbolic import Engine
from dtwin.twins._formulas import WithFormulas
from dtwin.twins._learn import learn_formula, learn_law
from dtwin.twins._stored import twin_from
from dtwin.twins.measured import Comparison, Loaded, load
from dtwin.twins.shelf import PATHS, TwinShelf, effect_absent, effect_there, require_same_machine

_MOST_RUNGS = 40


class Twins(TwinShelf):
    """The twins of a home that are of tests of a path.

    Parameters
    ----------
    library : mapping of str to Effect, optional
        Effects; the built-in ones and those of entry points without.
    """

    def __init__(self, home: Home, library: Mapping[str, Effect] | None = None) -> None:
        super().__init__(home, PATHS)
        others = Library() if library is None else library
        self.library = WithFormulas(others, home.root / "formulas")

    def fit(self, campaign: str, effects: Sequence[str], name: str, *, robust: bool = False) -> Twin:
        """Fit a twin to a campaign; an existing twin of that name gets a new version.

        Parameters
        ----------
        campaign : str
            Name in the lake, or a file or folder.
        effects : sequence of str
            Names; ``name:axis`` takes one axis.
        robust : bool
            Give runs that are far off less weight.
        """
        require_name(name, "the twin")
        loaded = load(self.home, campaign)
        terms = chosen_terms(effects, self.library, loaded.obs)
        return self._store(name, loaded, terms, "fit", robust=robust)

    def compare(self, name: str, campaign: str | None = None) -> Comparison:
        """Compare a twin with measurements.

        Parameters
        ----------
        campaign : str, optional
            Other measurements than those of the fit.

        Raises
        ------
        InputError
            When the campaign is of another machine.
        """
        twin = self.newest(name)
        loaded = load(self.home, campaign or twin.campaign)
        obs = loaded.obs
        require_same_machine(name, twin.machine, obs.campaign.name, obs.campaign.machine)
        outside = twin.box.outside(obs)
        warnings = data_lines(loaded.data)
        if outside:
            shown = ", ".join(outside[:4]) + (" ..." if len(outside) > 4 else "")
            warnings.append(f"outside the conditions of the fit: {shown}")
        residual = frozen_residual_um(twin, obs)
        before = localise.residual_um(obs, [])
        return Comparison(twin, obs, residual, before, tuple(warnings), loaded.controller_um)

    def budget(self, name: str, campaign: str | None = None) -> tuple[Twin, Budget]:
        """Return how much each effect of a twin makes of the error.

        Parameters
        ----------
        campaign : str, optional
            Other measurements than those of the fit.
        """
        twin = self.newest(name)
        obs = load(self.home, campaign or twin.campaign).obs
        require_same_machine(name, twin.machine, obs.campaign.name, obs.campaign.machine)
        return twin, budget(twin, obs)

    def diagnose(self, name: str, *, seed: int = 0) -> tuple[Twin, Diagnosis]:
        """Find out what a twin lacks."""
        twin = self.newest(name)
        loaded = load(self.home, twin.campaign)
        obs = loaded.obs
        diagnosis = diagnose(obs, twin.terms, self.library, seed=seed)
        proposed = next_experiment(obs, twin.terms, diagnosis, self.library)
        diagnosis = replace(diagnosis, next_experiment=proposed, told=tuple(data_lines(loaded.data)))
        document = {"twin": name, "version": twin.version, "campaign": twin.campaign}
        document |= diagnosis.as_dict()
        self.store_diagnosis(document)
        return twin, diagnosis

    def add(self, name: str, effect: str, axis: str = "") -> Twin:
        """Add an effect, refit, and store the new version.

        Parameters
        ----------
        effect : str
            Name of the effect, or ``name:axis``.
        axis : str
            One axis; all on which it can act without.

        Raises
        ------
        InputError
            When the twin has it already.
        """
        twin = self.newest(name)
        loaded = load(self.home, twin.campaign)
        new = chosen_terms([effect], self.library, loaded.obs, axis)
        fresh = [term for term in new if term.label not in twin.labels]
        if not fresh:
            raise effect_there(twin, effect)
        added = ", ".join(term.label for term in fresh)
        return self._store(name, loaded, [*twin.terms, *fresh], f"add {added}")

    def remove(self, name: str, effect: str, axis: str = "") -> Twin:
        """Take an effect out, refit, and store the new version.

        Raises
        ------
        InputError
            When the twin does not have it.
        """
        twin = self.newest(name)
        wanted, _, own = effect.partition(":")
        where = own or axis
        kept = [t for t in twin.terms if t.instance.effect.name != wanted or (where and t.instance.axis != where)]
        if len(kept) == len(twin.terms):
            raise effect_absent(twin, effect)
        loaded = load(self.home, twin.campaign)
        return self._store(name, loaded, kept, f"remove {effect}")

    def restore(self, name: str, version: int) -> Twin:
        """Refit with the effects of an older version, and store that as a new one.

        Parameters
        ----------
        version : int
            The version to go back to.
        """
        old = self.newest(name, version)
        return self._store(name, load(self.home, old.campaign), old.terms, f"restore v{version}")

    def learn(self, name: str, *, seed: int = 0) -> tuple[Twin, float]:
        """Add the scaling law that describes unknown structure best; see :func:`learn_law`."""
        return learn_law(self, name, seed)

    def learn_formula(self, name: str, engine: Engine, *, seed: int = 0) -> tuple[Twin, ResidualFormula]:
        """Add a formula for unknown structure; see :func:`dtwin.twins._learn`."""
        return learn_formula(self, name, engine, seed)

    def discover(self, name: str, *, seed: int = 0) -> tuple[list[Twin], list[tuple[str, ...]], Diagnosis]:
        """Diagnose and add all that was found, until nothing more is found.

        Returns
        -------
        twins : list of Twin
            The versions that were made, one for every effect.
        groups : list of tuple of str
            For each of them the effect and what cannot be told from it.
        diagnosis : Diagnosis
            The last word.
        """
        made: list[Twin] = []
        groups: list[tuple[str, ...]] = []
        _, said = self.diagnose(name, seed=seed)
        while said.found and len(made) < _MOST_RUNGS:
            for group in said.found:
                made.append(self.add(name, group[0].effect, group[0].axis))
                groups.append(tuple(suspect.label for suspect in group))
            _, said = self.diagnose(name, seed=seed)
        return made, groups, said

    def newest(self, name: str, version: int | None = None) -> Twin:
        """Return a version of a twin, the newest one without a number.

        Raises
        ------
        InputError
            When there is no such twin or version.
        StoreError
            When its file is damaged.
        """
        document, path = self.newest_document(name, version)
        return twin_from(document, self.library, str(path))

    def _store(self, name: str, loaded: Loaded, terms: Sequence[Term], action: str, *, robust: bool = False) -> Twin:
        version = self.next_version(name)
        found = fit(loaded.obs, terms, robust=robust)
        twin = twin_of(found, loaded.obs, name=name, version=version, action=action, data=loaded.data)
        self.store(twin.as_dict())
        return twin
