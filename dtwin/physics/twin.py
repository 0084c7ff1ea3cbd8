"""A twin: effects with fitted parameters, uncertainty, validity box and noise floor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dtwin.errors import InputError
from dtwin.physics import localise
from dtwin.physics._plausible import implausible
from dtwin.physics.effect import Effect, Instance
from dtwin.physics.fit import Estimate, Fit
from dtwin.physics.library import campaign_instances
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Term
from dtwin.physics.state import AXES_OF
from dtwin.schema import Floats
from dtwin.units import shown_number

FORMAT = "dtwin-twin/1"


@dataclass(frozen=True)
class ValidityBox:
    """Conditions that a twin was fitted to.

    Attributes:
        radius_mm, feed_mm_min: Smallest and largest.
    """

    planes: tuple[str, ...]
    directions: tuple[str, ...]
    radius_mm: tuple[float, float]
    feed_mm_min: tuple[float, float]

    @classmethod
    def of(cls, obs: Observations) -> ValidityBox:
        """Return the box of a campaign."""
        radii = [c.radius_mm for c in obs.conditions]
        feeds = [c.feed_mm_min for c in obs.conditions]
        return cls(
            obs.planes,
            tuple(sorted({c.direction for c in obs.conditions})),
            (min(radii), max(radii)),
            (min(feeds), max(feeds)),
        )

    def outside(self, obs: Observations) -> list[str]:
        """Return the conditions of a campaign that lie outside the box, as text."""
        return [
            str(c)
            for c in obs.conditions
            if c.plane not in self.planes
            or c.direction not in self.directions
            or not self.radius_mm[0] <= c.radius_mm <= self.radius_mm[1]
            or not self.feed_mm_min[0] <= c.feed_mm_min <= self.feed_mm_min[1]
        ]

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return {name: list(value) for name, value in vars(self).items()}


@dataclass(frozen=True)
class Twin:
    """Effects with fitted parameters.

    Attributes:
        version: Counts from 1; every rung is a version.
        action: What made this version, for example ``add backlash``.
        setups: Centre and radius of every set-up.
        box: Conditions that it was fitted to.
        figures: RMS before and after, systematic RMS and noise floor, um; condition number and rank.
        by_condition: RMS of every condition before and after.
        aliases: Pairs of effects that the runs cannot tell apart.
        data: Table versions and hash of the runs that were used.
        effect_sources: Where the effects that are not built in came from.
    """

    name: str
    version: int
    machine: str
    campaign: str
    action: str
    terms: tuple[Term, ...]
    estimates: tuple[Estimate, ...]
    setups: tuple[Mapping[str, Any], ...]
    box: ValidityBox
    figures: Mapping[str, float]
    by_condition: tuple[Mapping[str, Any], ...]
    aliases: tuple[Mapping[str, Any], ...]
    data: Mapping[str, Any]
    effect_sources: Mapping[str, str]

    @property
    def campaigns(self) -> tuple[str, ...]:
        """Campaigns that it was fitted to."""
        return (self.campaign,)

    def on(self, campaign: str) -> Twin:
        """Return the twin as one of its campaigns sees it."""
        return self

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of its effects."""
        return tuple(term.label for term in self.terms)

    @property
    def doubts(self) -> tuple[str, ...]:
        """Effects whose values or shapes are not plausible, in words."""
        values = np.concatenate([np.empty(0), *(self.values(term) for term in self.terms)])
        doubted = implausible(self.terms, values, on_circles=any(plane in AXES_OF for plane in self.box.planes))
        return tuple(f"{label} is not told by these runs: {why}" for label, why in doubted.items())

    def values(self, term: Term) -> Floats:
        """Return the fitted parameters of an effect, shape (parameters,)."""
        return np.array([e.value for e in self.estimates_of(term)])

    def estimates_of(self, term: Term) -> list[Estimate]:
        """Return the fitted parameters of an effect, in its order.

        Of an earlier version with what it took to be equal; what it did not know does nothing.
        """
        effect, axis = term.instance.effect, term.instance.axis
        mine = [e for e in self.estimates if (e.effect, e.axis) == (effect.name, axis)]
        if len(mine) == len(effect.parameters):
            # Of several campaigns they have the names that another one has for them.
            return mine
        stored = {e.name: e for e in mine}
        blank = Estimate(effect.name, axis, "", "", 0.0, float("nan"), identifiable=False)
        return [
            replace(stored.get(p.name) or stored.get(p.once) or blank, name=p.name, unit=p.unit)
            for p in effect.parameters
        ]

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return {
            "format": FORMAT,
            "twin": self.name,
            "version": self.version,
            "machine": self.machine,
            "campaign": self.campaign,
            "action": self.action,
            "effects": [
                {"effect": term.instance.effect.name, "axis": term.instance.axis, "shape": dict(term.shape)}
                for term in self.terms
            ],
            "parameters": [estimate.as_dict() for estimate in self.estimates],
            "setups": [dict(setup) for setup in self.setups],
            "box": self.box.as_dict(),
            "figures": dict(self.figures),
            "by_condition": [dict(row) for row in self.by_condition],
            "aliases": [dict(alias) for alias in self.aliases],
            "data": dict(self.data),
            "effect_sources": dict(self.effect_sources),
        }


def data_lines(data: Mapping[str, Any]) -> list[str]:
    """Return a line for each run that was left out, for each amendment of the metadata, and for a centre that moves."""
    out = [f"left out, {run}: {why}" for run, why in data.get("left_out", {}).items()]
    out += data.get("amended", [])
    if wander_um := data.get("wander_um", 0.0):
        out.append(
            f"the centre moves by {shown_number(wander_um, 2)} µm RMS between runs of one set-up: every run is given a centre of its own, "
            "and effects are told by what else they do"
        )
    return out


def twin_of(fit: Fit, obs: Observations, *, name: str, version: int, action: str, data: Mapping[str, Any]) -> Twin:
    """Freeze a fit as a version of a twin."""
    before = localise.residual_um(obs, [])
    return Twin(
        name=name,
        version=version,
        machine=obs.campaign.machine,
        campaign=obs.campaign.name,
        action=action,
        terms=fit.terms,
        estimates=fit.estimates,
        setups=fit.setups,
        box=ValidityBox.of(obs),
        figures={
            "rms_before_um": fit.rms_before_um,
            "rms_after_um": fit.rms_after_um,
            "systematic_rms_um": fit.systematic_rms_um,
            "noise_floor_um": fit.noise_floor_um,
            "noise_floor_dof": fit.noise_floor_dof,
            "condition_number": fit.condition,
            "rank": fit.rank,
            "columns": fit.n_columns,
        },
        by_condition=by_condition(obs, before, fit.residual_um),
        aliases=tuple(alias.as_dict() for alias in fit.aliases),
        data=data,
        effect_sources={
            t.instance.effect.name: t.instance.effect.source
            for t in fit.terms
            if t.instance.effect.source not in ("dtwin", "learned")
        },
    )


def by_condition(obs: Observations, before_um: Floats, after_um: Floats) -> tuple[Mapping[str, Any], ...]:
    """Return RMS before and after for every condition.

    Args:
        before_um: Residual before. Shape (rows, n).
        after_um: Residual after. Shape (rows, n).
    """
    out = []
    for number, condition in enumerate(obs.conditions):
        rows = obs.condition_of == number
        mask = obs.mask[rows]
        out.append(
            {
                **condition.as_dict(),
                "runs": len(set(obs.run_of[rows].tolist())),
                "rms_before_um": float(np.sqrt((before_um[rows][mask] ** 2).mean())),
                "rms_after_um": float(np.sqrt((after_um[rows][mask] ** 2).mean())),
            }
        )
    return tuple(out)


def predict_um(twin: Twin, obs: Observations) -> Floats:
    """Return what a twin's effects do in the runs of a campaign, without set-up terms.

    Args:
        obs: Runs; what was measured does not matter.

    Returns:
        Shape (rows, n).
    """
    out = np.zeros(obs.y_um.shape)
    for term in twin.terms:
        out += obs.regressors(term.instance, term.shape) @ twin.values(term)
    return out


def frozen_residual_um(twin: Twin, obs: Observations) -> Floats:
    """Return measured minus predicted, the parameters as they are, the set-ups fitted anew.

    Args:
        obs: Runs, not necessarily those of the fit.

    Returns:
        Shape (rows, n).
    """
    return localise.residual_um(obs.with_y(obs.y_um - predict_um(twin, obs)), [])


def chosen_terms(names: Sequence[str], library: Mapping[str, Effect], obs: Observations, axis: str = "") -> list[Term]:
    """Return effects by name, on every axis where they can act.

    Args:
        names: Names; ``name:axis`` takes one axis. Set-up terms are always fitted and may be named.
        axis: Take this axis only.

    Raises:
        InputError: When there is no such effect, or it cannot act here.
    """
    geometry = obs.campaign.machine_geometry
    named = {name.partition(":")[0] for name in names}
    wanted_here = {name: library[name] for name in named}
    possible = campaign_instances(wanted_here, obs.campaign.kind, obs.planes, obs.axes, geometry)
    out: list[Term] = []
    for wanted in names:
        name, _, own = wanted.partition(":")
        effect = library[name]
        if effect.setup:
            continue
        where = own or axis
        here = [i for i in possible if i.effect.name == name and (not where or i.axis == where)]
        here = [i for i in here if acts(obs, i)]
        if where == "" and effect.per == "machine_and_axis":
            here = here[:1]
        if not here:
            raise InputError(
                "an effect cannot act in this campaign",
                code="effect.where",
                got=f"{name} {where}".strip(),
                allowed=_allowed(possible, effect, where, obs),
            )
        out += [Term(i, i.effect.start_shape) for i in here]
    seen: dict[str, Term] = {}
    for term in out:
        seen.setdefault(term.label, term)
    return list(seen.values())


def acts(obs: Observations, instance: Instance) -> bool:
    """Tell whether an effect does anything in the runs of a campaign, with what they log."""
    if any(name not in obs.logged for name in instance.effect.needs):
        return False
    return bool(obs.regressors(instance, instance.effect.start_shape).any())


def _allowed(possible: Sequence[Instance], effect: Effect, where: str, obs: Observations) -> str:
    absent = [n for n in effect.needs if n not in obs.logged]
    if absent:
        return f"campaigns that log {', '.join(absent)}"
    axes = [i.axis for i in possible if i.effect.name == effect.name]
    if not axes:
        return f"campaigns of kind {', '.join(effect.kinds)}"
    silent = [n for n in effect.stated if n not in obs.campaign.machine_geometry]
    if silent:
        return f"campaigns that state machine_geometry.{', machine_geometry.'.join(silent)}"
    if where in ("", *axes):
        return f"runs in which it does something; {effect.separate_by[:1].lower()}{effect.separate_by[1:]}"
    return "on " + ", ".join(a or "the machine" for a in axes)
