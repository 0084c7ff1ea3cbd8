"""A map of what a twin leaves at each place of each circle, where all feeds agree, as a provisional effect."""

from __future__ import annotations

import json
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
    return {circle: np.array(found) for circle, found in out.items() if len(found) > 1}
