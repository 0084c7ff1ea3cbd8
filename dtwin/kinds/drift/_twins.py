"""Twins of drift: fit, compare, diagnose, add, remove, restore, discover, history."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dtwin.documents import finite
from dtwin.errors import InputError
from dtwin.kinds.drift._data import Loaded, load
from dtwin.kinds.drift._diagnosis import KIND, REPLICATION, DriftDiagnosis, diagnose, drift_figures_of
from dtwin.kinds.drift._effects import EFFECTS, asked, effect_of, joined, same, written
from dtwin.kinds.drift._model import Series, Term, fitted
from dtwin.kinds.drift._search import MOST_RUNGS, rung
from dtwin.schema import Floats
from dtwin.statistics import rms
from dtwin.twins.shelf import require_same_machine
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

    def same(self, one: Term, other: Term) -> bool:
        return same(one, other)

    def diagnosed(self, loaded: Loaded, terms: Sequence[Term]) -> DriftDiagnosis:
        return diagnose(loaded.series, terms)

    def compare(self, name: str, campaign: str | None = None) -> DriftComparison:
        """Compare a twin with the longest log of a campaign; only the zero is of that log."""
        twin = self.newest(name)
        loaded = load(self.home, campaign or twin.campaign)
        require_same_machine(name, twin.machine, loaded.campaign, loaded.machine)
        return DriftComparison(twin, loaded, twin.left_um(loaded.series))

    def discover(self, name: str, *, seed: int = 0) -> tuple[list[DriftTwin], list[tuple[str, ...]], DriftDiagnosis]:
        """Diagnose and add until nothing pays; what pays nothing beside the others is then taken out, one after the other."""
        twin = self.newest(name)
        loaded = load(self.home, twin.campaign)
        made: list[DriftTwin] = []
        groups: list[tuple[str, ...]] = []
        said = self._diagnosed(twin, loaded)
        while (said.group or said.idle) and len(made) < MOST_RUNGS:
            if said.group:
                action, group = f"add {said.additions[0]}", said.additions
            else:
                gone = said.idle[0]
                action, group = f"remove {written(gone)}: it pays nothing beside the others", ()
                groups = [group for group in groups if group[0] != written(gone)]
            terms = rung(twin.terms, said.group[0] if said.group else None, said.idle)
            twin = self._store(name, loaded, terms, action)
            made.append(twin)
            groups += [group] if group else []
            said = self._diagnosed(twin, loaded)
        return made, groups, said

    def fitted(self, loaded: Loaded, terms: Sequence[Term]) -> Mapping[str, Any]:
        model = fitted(loaded.series, terms)
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
                for t, k2_s in zip(terms, model.late_k2_s, strict=True)
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
                for t, value, k2 in zip(terms, model.value[1:], model.k2[1:], strict=True)
            ],
            "per_kelvin": [float(value) for value in model.value[1:]],
            "setup": {"zero_um": float(model.value[0])},
            "figures": finite(drift_figures_of(loaded.series, terms)),
            "replication": REPLICATION,
        }

    def stored(self, document: Mapping[str, Any]) -> DriftTwin:
        terms = tuple(
            Term(EFFECTS[e["effect"]].term, f"temperature_{e['axis']}_c", float(e["time_constant_s"] or 0.0))
            for e in document["effects"]
        )
        return DriftTwin.of(document, terms)
