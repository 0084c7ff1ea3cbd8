"""A formula for what a twin leaves, found by symbolic regression, as a provisional effect."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from dtwin.errors import GateRefusal
from dtwin.physics.effect import Effect, Law, Parameter, Shape
from dtwin.physics.gridding import N_BINS, bin_angle_rad
from dtwin.physics.localise import condition_means
from dtwin.physics.observations import Observations
from dtwin.physics.state import State
from dtwin.schema import Floats
from dtwin.train.formula import parse_formula
from dtwin.train.symbolic import Engine, FittedFormula, refit

# Ratios and pure numbers only, so that no formula can mix units; its value is in um.
# Harmonics instead of the angle itself, so that every formula closes on itself after a turn.
_HARMONICS = range(1, 9)
_INPUTS = (*(f"{w}{h}" for h in _HARMONICS for w in "cs"), "f", "r", "d")
_REFERENCE_FEED_MM_S = 50.0
_REFERENCE_RADIUS_MM = 100.0
_BINS_TOGETHER = 3
_NEAR = 1.02


@dataclass(frozen=True)
class ResidualFormula:
    """A formula and what it is worth.

    ``text``: in um; ``c5`` and ``s5`` are cosine and sine of five times the path angle, ``f`` is the feed over 50 mm/s,
    ``r`` the radius over 100 mm, ``d`` +1 counter-clockwise and -1 clockwise.
    ``gain``: share of the mean square that it takes away on conditions that search and constants never saw: a plane,
    radius and feed at a time.
    """

    text: str
    nodes: int
    gain: float
    groups: int

    @property
    def shown(self) -> str:
        """The formula with four digits, for people."""
        return re.sub(r"\d+\.\d+(e-?\d+)?", lambda m: f"{float(m[0]):.4g}", self.text)


def search_residual(obs: Observations, residual_um: Floats, engine: Engine, seed: int) -> ResidualFormula:
    """Search a formula for what repeats agree on, each time without one condition, then with all.

    ``residual_um``, shape (rows, 360): what the twin leaves.
    Raises ``GateRefusal`` with fewer than three conditions, of which none could be left out, or without a finite formula.
    """
    inputs, target, place_of = _table(obs, residual_um)
    places = sorted(set(place_of.tolist()))
    if len(places) < 3:
        raise GateRefusal(
            "a formula cannot be tested on conditions that were left out",
            code="twin.too_few_conditions",
            got=f"{len(places)} combinations of plane, radius and feed",
            allowed="3 or more",
        )
    before = after = 0.0
    for place in places:
        out = place_of == place
        model = _best(engine, {n: v[~out] for n, v in inputs.items()}, target[~out], seed)
        predicted = model.formula.values({n: v[out] for n, v in inputs.items()}, model.constants)
        before += float((target[out] ** 2).sum())
        after += float((target[out] - np.nan_to_num(predicted, nan=1e6)) ** 2 @ np.ones(out.sum()))
    final = _best(engine, inputs, target, seed)
    return ResidualFormula(
        text=final.formula.text(final.constants),
        nodes=final.complexity,
        gain=1.0 - after / before if before > 0.0 else 0.0,
        groups=len(places),
    )


def formula_effect(name: str, text: str) -> Effect:
    """Return the effect that a formula describes.

    ``text``: the formula; nothing but numbers, the inputs, arithmetic and known functions.
    Raises ``InputError`` when it holds anything else.
    """
    formula, constants = parse_formula(text, _INPUTS)

    def columns(state: State, axis: str, shape: Shape) -> Floats:
        values = formula.values(_inputs(state.angle_rad, state.feed_mm_s, state.radius_mm, state.direction), constants)
        return np.broadcast_to(values, state.n).astype(float)[:, None]

    return Effect(
        name=name,
        title="Learned formula",
        parameters=(Parameter("factor", "1", 1.0),),
        regressors=columns,
        law=Law(None, None, "mixed"),
        per="machine",
        meaning="Found in the residual by symbolic regression, not understood: a description.",
        formula=text,
        looks_like="What the twin left when it was found.",
        separate_by="Measure at feeds and radii that were not used to find it.",
        remedy="Find the cause before correcting for it.",
        reference="Learned from the residual of this twin; provisional.",
        source="learned",
    )


def _best(engine: Engine, inputs: Mapping[str, Floats], target: Floats, seed: int) -> FittedFormula:
    fitted = refit(engine.search(inputs, target, seed), inputs, target)
    if not fitted:
        raise GateRefusal("the search found no finite formula", code="twin.no_formula")
    limit = _NEAR * min(f.rms for f in fitted)
    return min((f for f in fitted if f.rms <= limit), key=lambda f: f.complexity)


def _table(obs: Observations, residual_um: Floats) -> tuple[dict[str, Floats], Floats, Floats]:
    """Return inputs, target and place of the means of the conditions, three degrees at a time."""
    means = condition_means(obs, residual_um).reshape(len(obs.conditions), -1, _BINS_TOGETHER)
    target = means.mean(axis=2)
    theta = bin_angle_rad().reshape(-1, _BINS_TOGETHER).mean(axis=1)
    parts = []
    for number, condition in enumerate(obs.conditions):
        rows = obs.condition_of == number
        sign = 1.0 if condition.direction == "CCW" else -1.0
        parts.append(_inputs(theta, float(obs.feed_mm_s[rows].mean()), condition.radius_mm, sign))
    n = N_BINS // _BINS_TOGETHER
    inputs = {name: np.concatenate([part[name] for part in parts]) for name in _INPUTS}
    place = [int(obs.place_of[obs.condition_of == c][0]) for c in range(len(obs.conditions))]
    return inputs, target.ravel(), np.repeat(place, n)


def _inputs(theta: Floats, feed_mm_s: float, radius_mm: float, sign: float) -> dict[str, Floats]:
    ones = np.ones_like(theta)
    waves = {f"{word}{h}": wave(h * theta) for h in _HARMONICS for word, wave in (("c", np.cos), ("s", np.sin))}
    return {
        **waves,
        "f": ones * (feed_mm_s / _REFERENCE_FEED_MM_S),
        "r": ones * (radius_mm / _REFERENCE_RADIUS_MM),
        "d": ones * sign,
    }
