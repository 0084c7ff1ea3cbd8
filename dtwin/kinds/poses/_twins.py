"""Twins of an arm: fit, compare, diagnose, add, remove, restore, discover, history."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dtwin.documents import finite
from dtwin.errors import InputError
from dtwin.kinds.poses._chain import Setup
from dtwin.kinds.poses._data import Loaded, load
from dtwin.kinds.poses._diagnosis import KIND, PoseDiagnosis, diagnose, pose_figures
from dtwin.kinds.poses._effects import EFFECTS, Term, terms_of
from dtwin.kinds.poses._fit import (
    Grams,
    dof_of,
    left_mm,
    left_with_mm,
    parameters_with,
    slots_of,
    solve,
    with_correlations,
)
from dtwin.kinds.poses._series import mean_mm
from dtwin.physics.agreed import Quantity, Sizes
from dtwin.schema import Floats
from dtwin.statistics import rms, t_quantile
from dtwin.twins.shelf import logged_together, require_same_machine
from dtwin.twins.term_twins import TermTwin, TermTwins

_MOST_RUNGS = 40
_PLACES, _FEWEST = 5, 10


PoseTwin = TermTwin[Term]
"""A fitted twin of an arm."""


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
            "noise_floor_um": 1000.0 * series.floor_of_left_mm(self.left_mm) if series.repeats else None,
            "where": [
                {
                    "row": int(self.loaded.rows[r]),
                    "joints_deg": np.degrees(series.poses.joints_rad[r]).round(2).tolist(),
                    "left_mm": float(size[r]),
                }
                for r in worst
            ],
            "warnings": [],
            "encoder_split": None,
        }


class PoseTwins(TermTwins[Term, Loaded, PoseTwin, PoseDiagnosis]):
    """The twins of a home that are of arms."""

    named, form = KIND, "dtwin-pose-twin-1"
    no_robust = "dtwin check names spoilt rows"

    def loaded(self, campaign: str) -> Loaded:
        """Return a campaign that a twin can be fitted to.

        Raises ``InputError`` when it has too few different poses, however often they were measured.
        """
        loaded = load(self.home, campaign)
        poses = int(loaded.grams.series.poses.place.max()) + 1
        if poses < _FEWEST:
            raise InputError(
                "too few different poses for a twin of an arm",
                code="poses.few",
                where=loaded.campaign,
                got=f"{poses} poses, {len(loaded.grams.series.error_mm)} readings",
                allowed=f"{_FEWEST} and more: frame and tool alone take nine numbers, the arm's errors the rest",
                hint="dtwin check tells the figures of ISO 9283; thirty poses and more tell what is wrong with the arm",
            )
        return loaded

    def asked(self, loaded: Loaded, effects: Sequence[str], axis: str) -> Sequence[Term]:
        terms = terms_of([f"{effect}@{axis}" if axis else effect for effect in effects], _joints(loaded))
        absent = [term for term in terms if term not in loaded.grams.series.slots]
        if absent:
            raise InputError(
                "the table has no column for this effect",
                code="effect.column",
                where=loaded.campaign,
                got=absent[0].label,
                allowed=EFFECTS[absent[0].effect].needs,
            )
        return terms

    def label(self, term: Term) -> str:
        return term.label

    def diagnosed(self, loaded: Loaded, terms: Sequence[Term]) -> PoseDiagnosis:
        return diagnose(loaded.grams, terms, loaded.rows)

    def against(self, twin: PoseTwin, campaign: str) -> PoseComparison:
        """Compare a twin with measurements; frame and tool are those of the campaign."""
        loaded = load(self.home, campaign)
        require_same_machine(twin.name, twin.machine, loaded.campaign, loaded.machine)
        same = load(self.home, loaded.campaign, _setup(twin))
        told = twin.document["parameters"]
        if loaded.campaign != twin.campaign:
            # How a set-up moved is of its own day.
            told = [parameter for parameter in told if parameter["effect"] != "setup_drift"]
        return PoseComparison(twin, loaded, _applied(loaded.grams, told), _as_fitted(twin, told, same))

    @logged_together
    def discover(self, name: str, *, seed: int = 0) -> tuple[list[PoseTwin], list[tuple[str, ...]], PoseDiagnosis]:
        """Diagnose and add until no effect pays; then what pays nothing beside the others is taken out, and so on.

        It ends with a set of effects from which nothing is taken, or that was there before. Groups are those of what is in
        the twin at the end.
        """
        twin = self.newest(name)
        loaded = self.loaded(twin.campaign)
        made: list[PoseTwin] = []
        groups: list[tuple[str, ...]] = []
        seen = {frozenset(twin.terms)}
        said = self._diagnosed(twin, loaded)
        while len(made) < _MOST_RUNGS:
            if said.additions:
                terms = [*twin.terms, *terms_of(said.additions[:1], _joints(loaded))]
                action = f"add {said.additions[0]}"
                groups.append(said.additions)
            else:
                terms = [term for term in twin.terms if term not in said.idle]
                if not made or frozenset(terms) in seen:
                    break
                gone = ", ".join(term.label for term in said.idle)
                pays = "it pays" if len(said.idle) == 1 else "they pay"
                action = f"remove {gone}: {pays} nothing beside the others"
                groups = [still for group in groups if (still := _without(group, said.idle))]
            twin = self._store(name, loaded, terms, action, twin.version)
            made.append(twin)
            seen.add(frozenset(terms))
            said = self._diagnosed(twin, loaded)
        return made, groups, said

    def counted(self, loaded: Loaded, twin: PoseTwin) -> tuple[int, int]:
        return 1, len(loaded.rows)

    def possible(self, loaded: Loaded) -> Sequence[Term]:
        return tuple(loaded.grams.series.slots)

    def cause(self, loaded: Loaded, term: Term) -> tuple[str, str] | None:
        effect = EFFECTS[term.effect]
        return None if effect.of_campaign else (effect.cause or effect.name, str(term.joint or ""))

    def sizes(self, loaded: Loaded, terms: Sequence[Term]) -> Sizes:
        """Return frame, tool and parameters that the poses tell, in the units that other tests have."""
        grams = loaded.grams
        told = grams.told(grams.series.chosen(terms))
        value, spread = solve(grams, told)
        covariance = with_correlations(grams, told, spread)
        of: dict[int, Quantity] = {}
        for term, number, i in slots_of(grams, terms):
            if cause := self.cause(loaded, term):
                of[i] = Quantity(*cause, *EFFECTS[term.effect].named(number)[:2], term.effect)
        scale = self._scale(loaded, terms)
        dof = np.full(len(told), dof_of(grams))
        return Sizes(tuple(of.get(i) for i in told), value * scale, covariance * np.outer(scale, scale), dof)

    def _scale(self, loaded: Loaded, terms: Sequence[Term]) -> Floats:
        """Return how many of its unit elsewhere one of each told parameter is."""
        grams = loaded.grams
        factor = {i: EFFECTS[term.effect].named(number)[2] for term, number, i in slots_of(grams, terms)}
        return np.array([factor.get(i, 1.0) for i in grams.told(grams.series.chosen(terms))])

    def told(self, loaded: Loaded, terms: Sequence[Term], sizes: Sizes) -> Mapping[str, Any]:
        grams, scale = loaded.grams, self._scale(loaded, terms)
        value = sizes.value / scale
        half = sizes.standard / scale * np.array([t_quantile(0.975, float(dof)) for dof in sizes.dof])
        return {
            "effects": [
                {"effect": t.effect, "axis": t.axis, "label": t.label, "title": EFFECTS[t.effect].title} for t in terms
            ],
            "parameters": [
                {
                    "effect": p.term.effect,
                    "axis": p.term.axis,
                    "name": p.name,
                    "value": finite(p.value),
                    "uncertainty": finite(p.k2),
                    "unit": p.unit,
                }
                for p in parameters_with(grams, terms, value, half)
            ],
            "setup": _setup_dict(loaded, value[:9]),
            "figures": finite(pose_figures(grams, terms, left_with_mm(grams, terms, value))),
            "replication": "block of neighbouring poses",
        }

    def stored(self, document: Mapping[str, Any]) -> PoseTwin:
        """Return the twin of a document; older ones told a joint that stays behind as a width below zero."""
        told = [
            {**p, "name": "lost", "value": None if p["value"] is None else -p["value"]} if p["name"] == "width" else p
            for p in document["parameters"]
        ]
        document = {**document, "parameters": told}
        terms = tuple(Term(e["effect"], int(e["axis"][1:]) if e["axis"] else 0) for e in document["effects"])
        return PoseTwin.of(document, terms)


def _without(group: tuple[str, ...], gone: Sequence[Term]) -> tuple[str, ...]:
    """Return a group that was found, its first name without terms that were taken out again; empty when none is left."""
    effect, _, joints = group[0].partition("@")
    out = {term.axis for term in gone if term.effect == effect}
    kept = [joint for joint in joints.split("+") if joint not in out]
    return (f"{effect}@{'+'.join(kept)}" if joints else effect, *group[1:]) if kept else ()


def _applied(grams: Grams, told: Sequence[Mapping[str, Any]]) -> Floats:
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


def _setup_dict(loaded: Loaded, change: Floats) -> dict[str, Any]:
    """Return frame and tool, and the small changes of both that the fit of the terms made, shape (9,)."""
    setup = loaded.grams.series.setup
    return {
        "rotation": setup.rotation.tolist(),
        "shift_mm": setup.shift_mm.tolist(),
        "tool_mm": setup.tool_mm.tolist(),
        "change": change.tolist(),
    }


def _setup(twin: PoseTwin) -> Setup:
    told = twin.document["setup"]
    return Setup(*(np.array(told[name]) for name in ("rotation", "shift_mm", "tool_mm")))


def _as_fitted(twin: PoseTwin, told: Sequence[Mapping[str, Any]], loaded: Loaded) -> Floats:
    left = _less(loaded.grams, told)
    return np.asarray(left - loaded.grams.series.design[:, :, :9] @ np.array(twin.document["setup"]["change"]))


def _numbered(told: Sequence[Mapping[str, Any]]) -> list[tuple[int, Mapping[str, Any]]]:
    """Return parameters with their number within the effect."""
    return [([n for n, _ in EFFECTS[p["effect"]].parameters].index(p["name"]), p) for p in told]


def _joints(loaded: Loaded) -> int:
    return int(loaded.grams.series.poses.joints_rad.shape[1])
