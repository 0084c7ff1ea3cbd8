"""Twins of drift: fit, compare, diagnose, add, remove, restore, discover, history."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dtwin.documents import finite
from dtwin.errors import InputError
from dtwin.kinds.drift._data import Loaded, load
from dtwin.kinds.drift._diagnosis import (
    EFFECTS,
    KIND,
    REPLICATION,
    DriftDiagnosis,
    asked,
    diagnose,
    drift_figures_of,
    effect_of,
    explained_together,
    joined,
    same,
    written,
)
from dtwin.kinds.drift._model import Series, Term, fitted, left_of
from dtwin.kinds.drift._search import MOST_RUNGS, rung
from dtwin.physics.agreed import Quantity, Sizes
from dtwin.schema import Floats
from dtwin.statistics import rms, t_quantile
from dtwin.twins.shelf import logged_together, require_same_machine
from dtwin.twins.term_twins import TermTwin, TermTwins

_PLACES = 5


class DriftTwin(TermTwin[Term]):
    """A fitted twin of drift."""

    def left_um(self, series: Series) -> Floats:
        """Return what the twin leaves of a log, whose zero is fitted, shape (n,)."""
        absent = [term.name for term in self.terms if term.channel not in series.temperatures_c]
        if absent:
            raise InputError(
                "the log lacks temperatures of the twin",
                code="twin.inputs",
                where=f"twin {self.name}",
                got=", ".join(absent),
                allowed=", ".join(Term("steady", c).name for c in series.temperatures_c),
            )
        told = [v * series.column(t) for v, t in zip(self.document["per_kelvin"], self.terms, strict=True)]
        left = series.moved_um - np.sum(told, axis=0)
        return np.asarray(left - left.mean())


@dataclass(frozen=True)
class DriftComparison:
    """A twin against a log; ``left_um`` (n,): what it leaves, with the zero of that log."""

    twin: DriftTwin
    loaded: Loaded
    left_um: Floats

    def as_dict(self, cutoff: object = None) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        series = self.loaded.series
        blocks = [(series.t_s[series.block == b], self.left_um[series.block == b]) for b in np.unique(series.block)]
        worst = sorted(blocks, key=lambda one: -rms(one[1]))[:_PLACES]
        return {
            "kind": KIND,
            "twin": self.twin.name,
            "version": self.twin.version,
            "campaign": self.loaded.campaign,
            "log": self.loaded.run_id,
            "runs": len(series.t_s),
            "rms_before_um": float(np.std(series.moved_um)),
            "residual_rms_um": rms(self.left_um),
            "noise_floor_um": finite(series.floor_um),
            "replication": REPLICATION,
            "where": [
                {"from_h": float(t[0]) / 3600.0, "to_h": float(t[-1]) / 3600.0, "residual_rms_um": rms(left)}
                for t, left in worst
            ],
            "warnings": [],
            "encoder_split": None,
        }


class DriftTwins(TermTwins[Term, Loaded, DriftTwin, DriftDiagnosis]):
    """The twins of a home that are of drift: each of the longest sound log of a campaign."""

    named, form = KIND, "dtwin-drift-twin-1"
    no_robust = "dtwin check stops spoilt logs"

    def loaded(self, campaign: str) -> Loaded:
        return load(self.home, campaign)

    def asked(self, loaded: Loaded, effects: Sequence[str], axis: str) -> Sequence[Term]:
        return asked(loaded.series, effects, axis)

    def label(self, term: Term) -> str:
        return written(term)

    def joined(self, loaded: Loaded, terms: Sequence[Term], more: Sequence[Term]) -> Sequence[Term]:
        """Return terms with others; a lag takes the place of what is at once."""
        return joined(loaded.series, terms, more)

    def refound(self, loaded: Loaded, terms: Sequence[Term]) -> Sequence[Term]:
        """Return terms with the time constants that this log alone gives them."""
        return joined(loaded.series, (), [replace(term, tau_s=0.0) for term in terms])

    def same(self, one: Term, other: Term) -> bool:
        return same(one, other)

    def diagnosed(self, loaded: Loaded, terms: Sequence[Term]) -> DriftDiagnosis:
        return diagnose(loaded.series, terms)

    def against(self, twin: DriftTwin, campaign: str) -> DriftComparison:
        """Compare a twin with the longest log of a campaign; only the zero is of that log."""
        loaded = load(self.home, campaign)
        require_same_machine(twin.name, twin.machine, loaded.campaign, loaded.machine)
        return DriftComparison(twin, loaded, twin.left_um(loaded.series))

    @logged_together
    def discover(self, name: str, *, seed: int = 0) -> tuple[list[DriftTwin], list[tuple[str, ...]], DriftDiagnosis]:
        """Diagnose and add until nothing pays; what pays nothing beside the others is then taken out, one after the other.

        What a search then finds that begins with every sensor and explains all, or goes on past what is not sure, is one step.
        """
        twin = self.newest(name)
        loaded = load(self.home, twin.campaign)
        made: list[DriftTwin] = []
        groups: list[tuple[str, ...]] = []
        said = self._diagnosed(twin, loaded)
        while (said.group or said.idle) and len(made) < MOST_RUNGS:
            if said.group:
                action, group = f"add {said.additions[0]}", said.alike
            else:
                gone = said.idle[0]
                action, group = f"remove {written(gone)}: it pays nothing beside the others", ()
            terms = rung(twin.terms, said.group[0] if said.group else None, said.idle)
            twin = self._store(name, loaded, terms, action, twin.version)
            made.append(twin)
            groups += [group] if group else []
            said = self._diagnosed(twin, loaded)
        if explained := explained_together(loaded.series, twin.terms):
            twin = self._store(
                name, loaded, explained, f"begin anew: {', '.join(map(written, explained))}", twin.version
            )
            made.append(twin)
            groups += [(label,) for label in twin.labels]
            said = self._diagnosed(twin, loaded)
        told = {group[0]: group for group in reversed(groups) if group[0] in twin.labels}
        return made, [told[label] for label in twin.labels if label in told], said

    def counted(self, loaded: Loaded, twin: DriftTwin) -> tuple[int, int]:
        return 1, len(loaded.series.t_s)

    def possible(self, loaded: Loaded) -> Sequence[Term]:
        return asked(loaded.series, EFFECTS)

    def cause(self, loaded: Loaded, term: Term) -> tuple[str, str] | None:
        """Return the effect, and the sensor with the axis that moved: another axis is another part of the machine."""
        return effect_of(term).name, f"{term.name} of {loaded.axis}" if loaded.axis else term.name

    def sizes(self, loaded: Loaded, terms: Sequence[Term]) -> Sizes:
        """Return the zero, what a kelvin does by each term, and the time constants, s."""
        model = fitted(loaded.series, terms)
        curved = {term.channel for term in terms if term.kind == "curve"}
        of: list[Quantity | None] = [None]
        for term in terms:
            # Beside a curve a slope is that at the mean temperature of its own log.
            own = term.channel in curved and term.kind != "curve"
            of.append(None if own else self._quantity(loaded, term, "per_kelvin", effect_of(term).unit))
        late = [term for term in terms if term.tau_s]
        of += [None if t.channel in curved else self._quantity(loaded, t, "time_constant", "s") for t in late]
        value = np.concatenate([model.value, [term.tau_s for term in late]])
        return Sizes(tuple(of), value, model.covariance, model.dof)

    def _quantity(self, loaded: Loaded, term: Term, parameter: str, unit: str) -> Quantity | None:
        cause = self.cause(loaded, term)
        return None if cause is None else Quantity(*cause, parameter, unit, effect_of(term).name)

    def told(self, loaded: Loaded, terms: Sequence[Term], sizes: Sizes) -> Mapping[str, Any]:
        series, first = loaded.series, 1 + len(terms)
        half = sizes.standard * np.array([t_quantile(0.975, float(dof)) for dof in sizes.dof])
        late = iter(zip(sizes.value[first:], half[first:], strict=True))
        taus = [next(late) if term.tau_s else (0.0, 0.0) for term in terms]
        terms = [replace(term, tau_s=float(tau)) for term, (tau, _) in zip(terms, taus, strict=True)]
        left_um, zero_um = left_of(series, terms, sizes.value[1:first])
        free = len(left_um) - first - len(series.touched_s)
        after_um = float(np.sqrt((left_um**2).sum() / max(free, 1)))
        return {
            "effects": [
                {
                    "effect": effect_of(t).name,
                    "axis": t.name,
                    "label": written(t),
                    "title": effect_of(t).title,
                    "time_constant_s": t.tau_s or None,
                    "time_constant_uncertainty_s": finite(float(k2_s)) or None,
                }
                for t, (_, k2_s) in zip(terms, taus, strict=True)
            ],
            "parameters": [
                {
                    "effect": effect_of(t).name,
                    "axis": t.name,
                    "name": "per_kelvin",
                    "value": float(value),
                    "uncertainty": finite(float(k2)),
                    "unit": effect_of(t).unit,
                }
                for t, value, k2 in zip(terms, sizes.value[1:first], half[1:first], strict=True)
            ],
            "per_kelvin": [float(value) for value in sizes.value[1:first]],
            "setup": {"zero_um": zero_um},
            "figures": finite(drift_figures_of(series, terms) | {"rms_after_um": after_um}),
            "replication": REPLICATION,
        }

    def stored(self, document: Mapping[str, Any]) -> DriftTwin:
        terms = tuple(
            Term(EFFECTS[e["effect"]].term, f"temperature_{e['axis']}_c", float(e["time_constant_s"] or 0.0))
            for e in document["effects"]
        )
        return DriftTwin.of(document, terms)
