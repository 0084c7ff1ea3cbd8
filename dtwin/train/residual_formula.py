"""A provisional effect for what a twin leaves: a formula, found by symbolic regression, or a map of places."""

from __future__ import annotations

import json
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
from dtwin.schema import Complexes, Floats
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


_SAME_RADIUS = 1e-3
_DIGITS = 5
# Plane, radius in mm, +1 counter-clockwise and -1 clockwise.
_Circle = tuple[str, float, float]


@dataclass(frozen=True)
class PlaceMap:
    """A map and what it is worth.

    ``text``: JSON: plane, radius in mm, direction (+1 CCW, -1 CW) and the error in um of every degree, of each circle.
    ``gain``: share of the mean square that it takes away at a feed that it did not see, with weights that never saw the
    place: a plane and radius at a time. The effects beside it are those of all runs.
    ``groups``: places of which each was left out once.
    """

    text: str
    gain: float
    groups: int


def place_map(obs: Observations, residual_um: Floats) -> PlaceMap:
    """Return the mean over the feeds of what is left, each wave weighted by how far the feeds agree in it.

    A wave that is the same at every feed belongs to the place: a screw, a scale, a guide. One that is not is noise, or
    moves with the feed, and has no place in a map. The weight is that of Wiener's filter, from cross spectra between
    feeds and power, both summed over the circles.

    ``residual_um``, shape (rows, 360): what the twin leaves.
    Raises ``GateRefusal`` with fewer than two places (plane and radius), each at two feeds: nothing could be left out.
    """
    spectra = _spectra(obs, residual_um)
    places = sorted({circle[:2] for circle in spectra})
    if len(places) < 2:
        raise GateRefusal(
            "a map of the residual cannot be tested on places that were left out",
            code="twin.too_few_conditions",
            got=f"{len(places)} combinations of plane and radius that were measured at two feeds or more",
            allowed="2 or more",
        )
    before = after = 0.0
    for place in places:
        weights = _Agreement.of({c: s for c, s in spectra.items() if c[:2] != place})
        for waves in (s for c, s in spectra.items() if c[:2] == place):
            others = (waves.sum(axis=0) - waves) / (len(waves) - 1)
            before += float((np.abs(waves) ** 2).sum())
            after += float((np.abs(waves - weights.of_mean(len(waves) - 1) * others) ** 2).sum())
    weights = _Agreement.of(spectra)
    circles = [
        [*circle, np.fft.irfft(weights.of_mean(len(waves)) * waves.mean(axis=0), obs.n_bins).round(_DIGITS).tolist()]
        for circle, waves in sorted(spectra.items())
    ]
    return PlaceMap(json.dumps(circles), 1.0 - after / before if before > 0.0 else 0.0, len(places))


def place_map_effect(name: str, text: str) -> Effect:
    """Return the effect that a map describes: nothing on circles that it does not hold.

    ``text``: of :class:`PlaceMap`.
    Raises ``ValueError``, ``TypeError`` when it is not a map.
    """
    circles: dict[_Circle, Floats] = {}
    for plane, radius, direction, error_um in json.loads(text):
        error = np.asarray(error_um, dtype=float)
        if error.shape != (N_BINS,) or not np.isfinite(error).all():
            raise ValueError(f"a circle has {error.size} errors instead of {N_BINS} numbers")
        circles[str(plane), float(radius), float(direction)] = error

    def columns(state: State, axis: str, shape: Shape) -> Floats:
        for (plane, radius, direction), error in circles.items():
            same = plane == state.plane and direction == state.direction
            if same and abs(radius - state.radius_mm) <= _SAME_RADIUS * radius:
                return np.interp(state.angle_rad, bin_angle_rad(), error, period=2.0 * np.pi)[:, None]
        return np.zeros((state.n, 1))

    return Effect(
        name=name,
        title="Learned map",
        parameters=(Parameter("factor", "1", 1.0),),
        regressors=columns,
        law=Law(0.0, None, "mixed"),
        per="machine",
        meaning="What is left at the same place of a circle at every feed, not understood: a description.",
        formula="error of each degree of each measured circle",
        looks_like="What the twin left, as far as all feeds agree.",
        separate_by="Measure circles with other centres and radii: what belongs to the place of an axis moves with it.",
        remedy="Find the cause before correcting for it: waves of a screw, a scale or a guide are likely.",
        reference="Learned from the residual of this twin; provisional.",
        source="learned",
    )


@dataclass(frozen=True)
class _Agreement:
    """Mean power of what feeds have in common, and of what they have not, of every wave: um² of the transform."""

    common: Floats
    own: Floats

    @classmethod
    def of(cls, spectra: Mapping[_Circle, Complexes]) -> _Agreement:
        power = sum((np.abs(s) ** 2).mean(axis=0) for s in spectra.values())
        cross = sum(
            (np.abs(s.sum(axis=0)) ** 2 - (np.abs(s) ** 2).sum(axis=0)) / (len(s) * (len(s) - 1))
            for s in spectra.values()
        )
        common = np.clip(cross, 0.0, power)
        return cls(common, power - common)

    def of_mean(self, feeds: int) -> Floats:
        """Return the weight of the mean of that many feeds, for every wave."""
        total = self.common + self.own / feeds
        return np.divide(self.common, total, out=np.zeros_like(total), where=total > 0.0)


def _spectra(obs: Observations, residual_um: Floats) -> dict[_Circle, Complexes]:
    """Return the transform of what is left of every circle that has two feeds or more, shape (feeds, waves)."""
    waves = np.fft.rfft(condition_means(obs, residual_um), axis=1)
    out: dict[_Circle, list[Complexes]] = {}
    for condition, spectrum in zip(obs.conditions, waves, strict=True):
        sign = 1.0 if condition.direction == "CCW" else -1.0
        out.setdefault((condition.plane, condition.radius_mm, sign), []).append(spectrum)
    return {circle: np.array(parts) for circle, parts in out.items() if len(parts) > 1}
