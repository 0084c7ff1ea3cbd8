"""Twins of an arm: fit, compare, diagnose, add, remove, restore, discover, history."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dtwin.config import Home
from dtwin.errors import InputError, StoreError
from dtwin.kinds.poses._data import Loaded, load
from dtwin.kinds.poses._diagnosis import KIND, PoseDiagnosis, diagnose, pose_figures
from dtwin.kinds.poses._effects import EFFECTS, Term, terms_of
from dtwin.kinds.poses._fit import Grams, left_mm, parameters, solve
from dtwin.kinds.poses._series import mean_mm
from dtwin.kinds.poses._setup import Setup
from dtwin.schema import Floats, require_name
from dtwin.statistics import rms
from dtwin.twins.shelf import TwinShelf, require_same_machine

FORMAT = "dtwin-pose-twin-1"
_MOST_RUNGS = 40
_PLACES = 5


@dataclass(frozen=True)
class PoseTwin:
    """A fitted twin of an arm; ``document`` is what is stored of it."""

    name: str
    version: int
    machine: str
    campaign: str
    action: str
    terms: tuple[Term, ...]
    figures: Mapping[str, float]
    document: Mapping[str, Any]

    @property
    def labels(self) -> tuple[str, ...]:
        """Terms as a user writes them."""
        return tuple(term.label for term in self.terms)

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return dict(self.document)


@dataclass(frozen=True)
class PoseComparison:
    """A twin against a campaign.

    ``left_mm`` (n, 3): what the twin leaves, with frame and tool fitted to this campaign.
    ``same_mounting_mm`` (n, 3): the same with frame and tool of the twin's own campaign: nothing is fitted here.
    """

    twin: PoseTwin
    loaded: Loaded
    left_mm: Floats
    same_mounting_mm: Floats

    def as_dict(self, cutoff: object = None) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        series = self.loaded.grams.series
        before = left_mm(self.loaded.grams, ())
        size = np.linalg.norm(self.left_mm, axis=1)
        worst = np.argsort(-size)[:_PLACES]
        return {
            "kind": KIND,
            "twin": self.twin.name,
            "version": self.twin.version,
            "campaign": self.loaded.campaign,
            "runs": len(size),
            "rms_before_um": 1000.0 * rms(np.linalg.norm(before, axis=1)),
            "residual_rms_um": 1000.0 * rms(size),
            "mean_before_mm": mean_mm(before),
            "mean_after_mm": mean_mm(self.left_mm),
            "mean_same_mounting_mm": mean_mm(self.same_mounting_mm),
            "noise_floor_um": 1000.0 * series.floor_mm if series.repeats else None,
            "where": [
                {
                    "row": int(r) + 1,
                    "joints_deg": np.degrees(series.poses.joints_rad[r]).round(2).tolist(),
                    "left_mm": float(size[r]),
                }
                for r in worst
            ],
            "warnings": [],
            "encoder_split": None,
        }


class PoseTwins(TwinShelf):
    """The twins of a home that are of arms."""

    def __init__(self, home: Home) -> None:
        super().__init__(home, KIND)

    def fit(self, campaign: str, effects: Sequence[str], name: str, *, robust: bool = False) -> PoseTwin:
        """Fit a twin to a campaign; an existing twin of that name gets a new version.

        Raises ``InputError`` when an effect is not known, or a robust fit is asked for.
        """
        require_name(name, "the twin")
        if robust:
            raise InputError(
                "a twin of poses has no robust fit", code="twin.robust", hint="dtwin check names spoilt rows"
            )
        loaded = load(self.home, campaign)
        return self._store(name, loaded, terms_of(tuple(effects), _joints(loaded)), "fit")

    def compare(self, name: str, campaign: str | None = None) -> PoseComparison:
        """Compare a twin with measurements; frame and tool are those of the campaign."""
        twin = self.newest(name)
        loaded = load(self.home, campaign or twin.campaign)
        require_same_machine(name, twin.machine, loaded.campaign, loaded.machine)
        same = load(self.home, loaded.campaign, _setup(twin))
        return PoseComparison(twin, loaded, applied(loaded.grams, twin.document["parameters"]), _as_fitted(twin, same))

    def diagnose(self, name: str, *, seed: int = 0) -> tuple[PoseTwin, PoseDiagnosis]:
        """Find out what a twin lacks; nothing here is random."""
        twin = self.newest(name)
        return twin, self._diagnosed(twin, load(self.home, twin.campaign))

    def add(self, name: str, effect: str, axis: str = "") -> PoseTwin:
        """Add an effect, of one joint or of all, refit, and store the new version."""
        twin = self.newest(name)
        loaded = load(self.home, twin.campaign)
        more = terms_of([f"{effect}@{axis}" if axis else effect], _joints(loaded))
        new = [term for term in more if term not in twin.terms]
        if not new:
            raise InputError(
                "the twin has this effect already", code="twin.has_effect", where=f"twin {name}", got=effect
            )
        return self._store(name, loaded, (*twin.terms, *new), f"add {', '.join(term.label for term in new)}")

    def remove(self, name: str, effect: str, axis: str = "") -> PoseTwin:
        """Take an effect out, of one joint or of all, refit, and store the new version."""
        twin = self.newest(name)
        loaded = load(self.home, twin.campaign)
        gone = terms_of([f"{effect}@{axis}" if axis else effect], _joints(loaded))
        kept = tuple(term for term in twin.terms if term not in gone)
        if len(kept) == len(twin.terms):
            allowed = ", ".join(twin.labels) or "it has none"
            raise InputError(
                "the twin does not have this effect",
                code="twin.no_effect",
                where=f"twin {name}",
                got=effect,
                allowed=allowed,
            )
        return self._store(name, loaded, kept, f"remove {effect}")

    def restore(self, name: str, version: int) -> PoseTwin:
        """Refit with the effects of an older version, and store that as a new one."""
        old = self.newest(name, version)
        return self._store(name, load(self.home, old.campaign), old.terms, f"restore v{version}")

    def discover(self, name: str, *, seed: int = 0) -> tuple[list[PoseTwin], list[tuple[str, ...]], PoseDiagnosis]:
        """Diagnose and add until no effect pays; what pays nothing beside the others at the end is taken out again."""
        twin = self.newest(name)
        loaded = load(self.home, twin.campaign)
        made: list[PoseTwin] = []
        groups: list[tuple[str, ...]] = []
        said = self._diagnosed(twin, loaded)
        while said.additions and len(made) < _MOST_RUNGS:
            new = terms_of(said.additions[:1], _joints(loaded))
            twin = self._store(name, loaded, (*twin.terms, *new), f"add {said.additions[0]}")
            made.append(twin)
            groups.append(said.additions)
            said = self._diagnosed(twin, loaded)
        if made and said.idle:
            kept = [term for term in twin.terms if term not in said.idle]
            gone = ", ".join(term.label for term in said.idle)
            made.append(self._store(name, loaded, kept, f"remove {gone}: they pay nothing beside the others"))
            groups.append((gone,))
            said = self._diagnosed(made[-1], loaded)
        return made, groups, said

    def newest(self, name: str, version: int | None = None) -> PoseTwin:
        """Return a version of a twin, the newest one without a number."""
        document, path = self.newest_document(name, version)
        if document.get("format") != FORMAT:
            raise StoreError("this is not a twin of poses", code="twin.format", where=str(path), allowed=FORMAT)
        return _from(document)

    def _diagnosed(self, twin: PoseTwin, loaded: Loaded) -> PoseDiagnosis:
        diagnosis = diagnose(loaded.grams, twin.terms)
        named = {"twin": twin.name, "version": twin.version, "campaign": twin.campaign}
        self.store_diagnosis({**named, **diagnosis.as_dict()})
        return diagnosis

    def _store(self, name: str, loaded: Loaded, terms: Sequence[Term], action: str) -> PoseTwin:
        figures = {k: v if np.isfinite(v) else None for k, v in pose_figures(loaded.grams, terms).items()}
        document = {
            "format": FORMAT,
            "kind": KIND,
            "twin": name,
            "version": self.next_version(name),
            "machine": loaded.machine,
            "campaign": loaded.campaign,
            "action": action,
            "effects": [
                {"effect": t.effect, "axis": t.axis, "label": t.label, "title": EFFECTS[t.effect].title} for t in terms
            ],
            "parameters": [
                {
                    "effect": p.term.effect,
                    "axis": p.term.axis,
                    "name": p.name,
                    "value": p.value if np.isfinite(p.value) else None,
                    "uncertainty": p.k2 if np.isfinite(p.k2) else None,
                    "unit": p.unit,
                }
                for p in parameters(loaded.grams, terms)
            ],
            "setup": _setup_dict(loaded, terms),
            "figures": figures,
            "data": dict(loaded.data),
            "replication": "block of neighbouring poses",
        }
        self.store(document)
        return _from(document)


def applied(grams: Grams, told: Sequence[Mapping[str, Any]]) -> Floats:
    """Return errors (n, 3) less stored parameters, with frame and tool of this campaign fitted."""
    left = _less(grams, told)
    setup = grams.series.design[:, :, :9].reshape(-1, 9)
    fitted = setup @ np.linalg.lstsq(setup, left.ravel(), rcond=1e-10)[0]
    return np.asarray(left - fitted.reshape(left.shape))


def _less(grams: Grams, told: Sequence[Mapping[str, Any]]) -> Floats:
    series = grams.series
    left = series.error_mm.copy()
    for number, parameter in _numbered(told):
        term = Term(parameter["effect"], int(parameter["axis"][1:] or 0) if parameter["axis"] else 0)
        if parameter["value"] is not None and term in series.slots:
            left = left - parameter["value"] * series.design[:, :, series.slots[term].start + number]
    return left


def _setup_dict(loaded: Loaded, terms: Sequence[Term]) -> dict[str, Any]:
    """Return frame and tool, and the small changes of both that the fit of the terms made."""
    series = loaded.grams.series
    told = loaded.grams.told(series.chosen(terms))
    setup = series.setup
    return {
        "rotation": setup.rotation.tolist(),
        "shift_mm": setup.shift_mm.tolist(),
        "tool_mm": setup.tool_mm.tolist(),
        "change": solve(loaded.grams, told)[0][:9].tolist(),
    }


def _setup(twin: PoseTwin) -> Setup:
    told = twin.document["setup"]
    return Setup(*(np.array(told[name]) for name in ("rotation", "shift_mm", "tool_mm")))


def _as_fitted(twin: PoseTwin, loaded: Loaded) -> Floats:
    left = _less(loaded.grams, twin.document["parameters"])
    return np.asarray(left - loaded.grams.series.design[:, :, :9] @ np.array(twin.document["setup"]["change"]))


def _numbered(told: Sequence[Mapping[str, Any]]) -> list[tuple[int, Mapping[str, Any]]]:
    """Return parameters with their number within the effect."""
    return [([n for n, _ in EFFECTS[p["effect"]].parameters].index(p["name"]), p) for p in told]


def _joints(loaded: Loaded) -> int:
    return int(loaded.grams.series.poses.joints_rad.shape[1])


def _from(document: Mapping[str, Any]) -> PoseTwin:
    terms = tuple(Term(e["effect"], int(e["axis"][1:]) if e["axis"] else 0) for e in document["effects"])
    head = {key: document[key] for key in ("version", "machine", "campaign", "action")}
    return PoseTwin(name=document["twin"], terms=terms, figures=document["figures"], document=document, **head)
