"""Whether the amplitude of an effect follows its law over feed, radius and direction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dtwin.physics.candidates import Candidate, Candidates
from dtwin.physics.gridding import N_BINS
from dtwin.physics.problem import Problem
from dtwin.physics.score import NoiseLevel, score_test
from dtwin.schema import Floats

MATERIAL = 0.35
_CONFIRMED = 0.3
_ALPHA = 0.002


@dataclass(frozen=True)
class LawTest:
    """Result for one variable.

    Attributes
    ----------
    variable : {"feed", "radius", "direction"}
        What the amplitude was compared over.
    p_value : float
        Of the hypothesis that the law holds.
    shift : float
        Change of the exponent that fits best; for the direction, half the relative difference.
    uncertainty : float
        Standard uncertainty of the shift.
    """

    variable: str
    p_value: float
    shift: float
    uncertainty: float

    @property
    def broken(self) -> bool:
        """Whether the law is rejected by a material amount."""
        return self.p_value < _ALPHA and abs(self.shift) > MATERIAL

    @property
    def confirmed(self) -> bool:
        """Whether the law holds and another one was ruled out."""
        return not self.broken and self.uncertainty < _CONFIRMED

    def as_dict(self) -> dict[str, float | str | bool]:
        """Return a JSON-ready mapping."""
        return {
            "variable": self.variable,
            "p_value": self.p_value,
            "shift": self.shift,
            "uncertainty": self.uncertainty,
            "broken": self.broken,
        }


def law_tests(
    problem: Problem, candidates: Candidates, candidate: Candidate, level: NoiseLevel
) -> list[LawTest]:
    """Test the law of a candidate over every variable that the campaign changed.

    Parameters
    ----------
    problem : Problem
        Whitened campaign, without the candidate.
    candidates : Candidates
        Evaluated library.
    candidate : Candidate
        The effect.
    level : NoiseLevel
        Shared noise level.
    """
    term = candidate.term
    law = term.instance.effect.law
    columns = candidates.whitened(problem, term)
    with_it = problem.extended(candidate.visible, columns)
    amplitude = _along(problem, columns)
    out = []
    for variable, contrast in _contrasts(problem).items():
        if variable == "feed" and law.feed is None:
            continue
        if variable == "radius" and law.radius is None:
            continue
        if variable == "direction" and law.direction == "mixed":
            continue
        # The effect as fitted, scaled by the contrast: one column, whatever the effect has.
        profile = (amplitude.reshape(-1, N_BINS) * contrast[:, None]).reshape(-1, 1)
        visible, share = with_it.visible(profile)
        if not visible.shape[1]:
            continue
        within = term.instance.effect.within_condition
        score = score_test(with_it, visible, with_it.residual, level, within=within)
        size = float(np.sqrt((profile**2).sum() * share[0]))
        sign = float(np.sign(visible[:, 0] @ profile[:, 0]))
        shift = sign * float(visible[:, 0] @ with_it.residual.ravel()) / size
        out.append(LawTest(variable, score.p_value, shift, float(np.sqrt(score.expected)) / size))
    return out


def _along(problem: Problem, columns: Floats) -> Floats:
    """Return the effect with the amplitudes that fit best, shape (rows * 360,)."""
    left = columns - problem.basis @ (problem.basis.T @ columns)
    amplitude = np.linalg.lstsq(left, problem.residual.ravel(), rcond=1e-8)[0]
    return np.asarray(columns @ amplitude)


def _contrasts(problem: Problem) -> dict[str, Floats]:
    obs = problem.obs
    feed = np.log(obs.feed_mm_s)
    radius = np.log([meta.radius_mm or 1.0 for meta in obs.runs])
    direction = np.array([1.0 if meta.direction == "CCW" else -1.0 for meta in obs.runs])
    found = {"feed": feed, "radius": radius, "direction": direction}
    return {name: values - values.mean() for name, values in found.items() if np.ptp(values) > 0.05}
