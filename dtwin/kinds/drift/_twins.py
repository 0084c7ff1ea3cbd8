"""Twins of drift: fit, compare, diagnose, add, remove, restore, discover, history."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dtwin.config import Home
from dtwin.errors import InputError, StoreError
from dtwin.kinds.drift._data import Loaded, load
from dtwin.kinds.drift._diagnosis import KIND, REPLICATION, DriftDiagnosis, diagnose, drift_figures_of
from dtwin.kinds.drift._effects import EFFECTS, asked, effect_of, finite, joined, same, written
from dtwin.kinds.drift._model import Series, Term, fitted
from dtwin.schema import Floats, require_name
from dtwin.statistics import rms
from dtwin.twins.shelf import TwinShelf, require_same_machine

FORMAT = "dtwin-drift-twin-1"
_MOST_RUNGS = 20
_PLACES = 5


@dataclass(frozen=True)
class DriftTwin:
    """A fitted twin of drift; ``document`` is what is stored of it."""

    name: str
    version: int
    machine: str
    campaign: str
    action: str
    terms: tuple[Term, ...]
    figures: Mapping[str, float | None]
    document: Mapping[str, Any]

    @property
    def labels(self) -> tuple[str, ...]:
        """Terms as a user writes them."""
        return tuple(written(term) for term in self.terms)

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return dict(self.document)

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


class DriftTwins(TwinShelf):
    """The twins of a home that are of drift."""

    def __init__(self, home: Home) -> None:
        super().__init__(home, KIND)

    def fit(self, campaign: str, effects: Sequence[str], name: str, *, robust: bool = False) -> DriftTwin:
        """Fit a twin to the longest sound log of a campaign; an existing twin of that name gets a new version.

        Raises ``InputError`` when an effect or a sensor is not known, or a robust fit is asked for.
        """
        require_name(name, "the twin")
        if robust:
            raise InputError(
                "a twin of drift has no robust fit", code="twin.robust", hint="dtwin check stops spoilt logs"
            )
        loaded = load(self.home, campaign)
        terms = joined(loaded.series, (), asked(loaded.series, effects))
        return self._store(name, loaded, terms, "fit")

    def compare(self, name: str, campaign: str | None = None) -> DriftComparison:
        """Compare a twin with the longest log of a campaign; only the zero is of that log."""
        twin = self.newest(name)
        loaded = load(self.home, campaign or twin.campaign)
        require_same_machine(name, twin.machine, loaded.campaign, loaded.machine)
        return DriftComparison(twin, loaded, twin.left_um(loaded.series))

    def diagnose(self, name: str, *, seed: int = 0) -> tuple[DriftTwin, DriftDiagnosis]:
        """Find out what a twin lacks; nothing here is random."""
        twin = self.newest(name)
        return twin, self._diagnosed(twin, load(self.home, twin.campaign))

    def add(self, name: str, effect: str, axis: str = "") -> DriftTwin:
        """Add an effect of a sensor, or of all, refit, and store the new version; a lag takes the place of what is at once."""
        twin = self.newest(name)
        loaded = load(self.home, twin.campaign)
        more = [t for t in asked(loaded.series, [effect], axis) if not any(same(t, old) for old in twin.terms)]
        if not more:
            raise InputError(
                "the twin has this effect already", code="twin.has_effect", where=f"twin {name}", got=effect
            )
        terms = joined(loaded.series, twin.terms, more)
        return self._store(name, loaded, terms, f"add {', '.join(written(t) for t in more)}")

    def remove(self, name: str, effect: str, axis: str = "") -> DriftTwin:
        """Take an effect out, of one sensor or of all, refit, and store the new version."""
        twin = self.newest(name)
        loaded = load(self.home, twin.campaign)
        gone = asked(loaded.series, [effect], axis)
        kept = tuple(term for term in twin.terms if not any(same(term, one) for one in gone))
        if len(kept) == len(twin.terms):
            raise InputError(
                "the twin does not have this effect",
                code="twin.no_effect",
                where=f"twin {name}",
                got=effect,
                allowed=", ".join(twin.labels) or "it has none",
            )
        return self._store(name, loaded, kept, f"remove {effect}{f'@{axis}' if axis else ''}")

    def restore(self, name: str, version: int) -> DriftTwin:
        """Refit with the effects of an older version, and store that as a new one."""
        old = self.newest(name, version)
        return self._store(name, load(self.home, old.campaign), old.terms, f"restore v{version}")

    def discover(self, name: str, *, seed: int = 0) -> tuple[list[DriftTwin], list[tuple[str, ...]], DriftDiagnosis]:
        """Diagnose and add until nothing pays; what pays nothing beside the others is then taken out, one after the other."""
        twin = self.newest(name)
        loaded = load(self.home, twin.campaign)
        made: list[DriftTwin] = []
        groups: list[tuple[str, ...]] = []
        said = self._diagnosed(twin, loaded)
        while (said.group or said.idle) and len(made) < _MOST_RUNGS:
            if said.group:
                terms, action, group = said.group[0].terms, f"add {said.additions[0]}", said.additions
            else:
                gone = said.idle[0]
                terms = tuple(term for term in twin.terms if term != gone)
                action, group = f"remove {written(gone)}: it pays nothing beside the others", (written(gone),)
            twin = self._store(name, loaded, terms, action)
            made.append(twin)
            groups.append(group)
            said = self._diagnosed(twin, loaded)
        return made, groups, said

    def newest(self, name: str, version: int | None = None) -> DriftTwin:
        """Return a version of a twin, the newest one without a number."""
        document, path = self.newest_document(name, version)
        try:
            if document["format"] != FORMAT:
                raise ValueError(f"format {document['format']}")
            return _from(document)
        except (KeyError, TypeError, ValueError) as error:
            raise StoreError(
                "this is not a twin of drift", code="twin.format", where=str(path), allowed=FORMAT, got=str(error)[:80]
            ) from error

    def _diagnosed(self, twin: DriftTwin, loaded: Loaded) -> DriftDiagnosis:
        diagnosis = diagnose(loaded.series, twin.terms)
        named = {"twin": twin.name, "version": twin.version, "campaign": twin.campaign}
        self.store_diagnosis({**named, **diagnosis.as_dict()})
        return diagnosis

    def _store(self, name: str, loaded: Loaded, terms: Sequence[Term], action: str) -> DriftTwin:
        model = fitted(loaded.series, terms)
        document = {
            "format": FORMAT,
            "kind": KIND,
            "twin": name,
            "version": self.next_version(name),
            "machine": loaded.machine,
            "campaign": loaded.campaign,
            "action": action,
            "effects": [
                {
                    "effect": effect_of(t).name,
                    "axis": t.name,
                    "label": written(t),
                    "title": effect_of(t).title,
                    "time_constant_s": t.tau_s or None,
                }
                for t in terms
            ],
            "parameters": [
                {
                    "effect": effect_of(t).name,
                    "axis": t.name,
                    "name": "per_kelvin",
                    "value": float(value),
                    "uncertainty": finite(k2),
                    "unit": effect_of(t).unit,
                }
                for t, value, k2 in zip(terms, model.value[1:], model.k2[1:], strict=True)
            ],
            "per_kelvin": [float(value) for value in model.value[1:]],
            "setup": {"zero_um": float(model.value[0])},
            "figures": {k: finite(v) for k, v in drift_figures_of(loaded.series, terms).items()},
            "data": dict(loaded.data),
            "replication": REPLICATION,
        }
        self.store(document)
        return _from(document)


def _from(document: Mapping[str, Any]) -> DriftTwin:
    terms = tuple(
        Term(EFFECTS[e["effect"]].term, f"temperature_{e['axis']}_c", float(e["time_constant_s"] or 0.0))
        for e in document["effects"]
    )
    head = {key: document[key] for key in ("version", "machine", "campaign", "action")}
    return DriftTwin(name=document["twin"], terms=terms, figures=document["figures"], document=document, **head)
