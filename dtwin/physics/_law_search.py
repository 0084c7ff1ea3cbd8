"""Scaling laws of structure that no effect explains: harmonic, direction, feed and radius."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np

from dtwin.physics.observations import Observations
from dtwin.physics.problem import INVISIBLE, Problem
from dtwin.physics.whitening import harmonic_numbers, within_condition
from dtwin.schema import Floats
from dtwin.statistics import f_tail, holm
from dtwin.units import shown_number

_FEED_EXPONENTS = (-1.0, 0.0, 0.5, 1.0, 2.0)
_RADIUS_EXPONENTS = (-1.0, 0.0, 1.0, 2.0, 3.0)
_HARMONICS = range(9)
_ALPHA = 0.005
_NEAR = 6.0

LawKey = tuple[int, bool, float, float]


@dataclass(frozen=True)
class ScalingLaw:
    """F^a R^b, one harmonic, even or odd in direction.

    ``harmonic``: per turn.
    ``odd``: changes sign with the direction.
    ``feed``, ``radius``: exponents.
    ``p_value``: after Holm over all laws.
    ``gain``: explained sum of squares beyond noise, whitened.
    ``amplitude_um``: amplitude at the mean feed and radius.
    """

    harmonic: int
    odd: bool
    feed: float
    radius: float
    p_value: float
    gain: float
    amplitude_um: float

    @property
    def equation(self) -> str:
        """The law as text, with the unit of its coefficient."""
        sign = "d " if self.odd else ""
        wave = f"cos({self.harmonic}t + p)" if self.harmonic else "1"
        feed = "" if self.feed == 0.0 else f" (F/F0)^{self.feed:g}"
        radius = "" if self.radius == 0.0 else f" (R/R0)^{self.radius:g}"
        return f"{shown_number(self.amplitude_um)} µm {sign}{wave}{feed}{radius}"

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return {**vars(self), "equation": self.equation}


def search_laws(problem: Problem) -> list[ScalingLaw]:
    """Return the laws that are significant and within noise of the best one.

    ``problem``: whitened campaign with everything known.
    Best first; empty when nothing is significant after Holm over all laws.
    """
    obs = problem.obs
    feeds = obs.feed_mm_s / np.exp(np.mean(np.log(obs.feed_mm_s)))
    radii = obs.radius_mm / np.exp(np.mean(np.log(obs.radius_mm)))
    keys = law_keys(obs)
    scale = {key: feeds ** key[2] * radii ** key[3] * (obs.sense if key[1] else 1.0) for key in keys}
    tester = _Tester(problem)
    tested = [tester.test(key[0], scale[key]) for key in keys]
    adjusted = holm([t[0] for t in tested])
    gains = np.array([t[1] for t in tested])
    best = int(np.argmax(gains))
    if adjusted[best] > _ALPHA:
        return []
    near = [i for i in np.argsort(-gains) if gains[i] > gains[best] - _NEAR * tested[best][2]]
    return [
        ScalingLaw(
            harmonic=keys[i][0],
            odd=keys[i][1],
            feed=keys[i][2],
            radius=keys[i][3],
            p_value=float(adjusted[i]),
            gain=float(gains[i]),
            amplitude_um=tested[i][3],
        )
        for i in near
    ]


def law_keys(obs: Observations) -> list[LawKey]:
    """Return harmonic, odd, exponents of feed and radius of every law that a campaign can tell."""
    feed_laws = _FEED_EXPONENTS if np.ptp(np.log(obs.feed_mm_s)) > 0.05 else (0.0,)
    radius_laws = _RADIUS_EXPONENTS if np.ptp(np.log(obs.radius_mm)) > 0.05 else (0.0,)
    odds = (False, True) if np.ptp(obs.sense) > 0.0 else (False,)
    harmonics = [h for h in _HARMONICS if h <= (obs.n_bins - 1) // 2]
    return list(itertools.product(harmonics, odds, feed_laws, radius_laws))


class _Tester:
    """Tests laws; what all of them share is computed once."""

    def __init__(self, problem: Problem) -> None:
        obs = problem.obs
        self.weights = problem.weights
        self.condition_of = obs.condition_of
        self.repeats = np.maximum(np.bincount(obs.condition_of) - 1, 0)
        self.residual = problem.residual
        self.deviation, _ = within_condition(self.residual, obs.condition_of)
        self.basis = problem.basis.reshape(obs.n_rows, obs.n_bins, -1)
        self.through = np.einsum("nqp,nq->np", self.basis, self.deviation)
        self.n_bins = obs.n_bins
        self.harmonics = harmonic_numbers(obs.n_bins)

    def test(self, harmonic: int, scale: Floats) -> tuple[float, float, float, float]:
        """Return p-value, gain, gain expected from noise, and amplitude of one law."""
        # A law lives in the two coefficients of its harmonic, which keeps this cheap.
        slots = np.flatnonzero(self.harmonics == harmonic)
        weights, k = self.weights[slots], len(slots)
        size = float((scale**2).sum())
        shared = weights[:, None] * np.tensordot(scale, self.basis[:, slots, :], axes=(0, 0))
        gram = np.diag(weights**2 * size) - shared @ shared.T
        if np.trace(gram) < 2 * INVISIBLE * (weights**2).sum() * size:
            return 1.0, 0.0, 0.0, 0.0
        total = weights * (scale @ self.residual[:, slots])
        direct = scale[:, None] * weights[None, :] * self.deviation[:, slots]
        scores = direct - self.through @ shared.T
        variance = scores.T @ scores
        inverse = np.linalg.pinv(gram, rcond=1e-6)
        explained = float(total @ inverse @ total)
        expected = float(np.trace(inverse @ variance))
        dof = self._dof(scores)
        left = max(dof - k + 1.0, 1.0)
        f = float(total @ np.linalg.pinv(variance) @ total) / k * left / max(dof, 1.0)
        fitted = inverse @ total
        amplitude = float(np.linalg.norm(fitted)) * np.sqrt((2.0 if harmonic else 1.0) / self.n_bins)
        return f_tail(f, (k, left)), max(0.0, explained - expected), expected, amplitude

    def _dof(self, scores: Floats) -> float:
        """Return Satterthwaite's degrees of freedom: steep laws live on few conditions."""
        power = np.bincount(self.condition_of, (scores**2).sum(axis=1))
        used = (self.repeats > 0) & (power > 0.0)
        if not used.any():
            return 0.0
        return float(power[used].sum() ** 2 / (power[used] ** 2 / self.repeats[used]).sum())
