"""See where a twin fails: by condition, by angle, and in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dtwin.physics.observations import Observations
from dtwin.physics.problem import Problem, Term, unweighted
from dtwin.physics.whitening import from_harmonics, harmonic_numbers, to_harmonics
from dtwin.schema import Floats

_SECTORS = 18
_PLACES = 5


def residual_um(obs: Observations, known: Sequence[Term]) -> Floats:
    """Return what ordinary least squares leaves, shape (rows, n), zero where not measured."""
    return in_angle(unweighted(obs, known))


def in_angle(problem: Problem) -> Floats:
    """Return the residual of an unweighted problem over the angle, shape (rows, n)."""
    return from_harmonics(problem.residual) * problem.obs.mask


def condition_means(obs: Observations, values: Floats) -> Floats:
    """Return the mean over the repeats of each condition, shape (conditions, n)."""
    return np.array([values[obs.condition_of == c].mean(axis=0) for c in range(len(obs.conditions))])


def systematic_rms_um(obs: Observations, residual: Floats) -> float:
    """Return the RMS of what repeats agree on: residual minus noise, in quadrature.

    ``residual``, (rows, n): residual of the twin.
    Returns sqrt(max(0, MS_residual - MS_pure_error)); NaN without repeats.
    """
    count = np.bincount(obs.condition_of)
    repeated = count[obs.condition_of] > 1
    dof = int(repeated.sum()) - int((count > 1).sum())
    if dof < 1:
        return float("nan")
    rows = residual[repeated]
    mean = condition_means(obs, residual)[obs.condition_of[repeated]]
    share = float(obs.mask[repeated].mean()) * obs.n_bins
    pure = ((rows - mean) ** 2).sum() / dof / share
    total = (rows**2).sum() / len(rows) / share
    return float(np.sqrt(max(0.0, total - pure)))


def worst_places(obs: Observations, residual: Floats) -> tuple[Mapping[str, Any], ...]:
    """Return the sectors in which the mean residual of a condition is largest.

    ``residual``, (rows, n): residual of the twin.
    """
    means = condition_means(obs, residual)
    edges = np.linspace(0, obs.n_bins, min(_SECTORS, obs.n_bins) + 1).round().astype(int)
    parts = np.add.reduceat(means**2, edges[:-1], axis=1) / np.diff(edges)
    sectors = np.sqrt(parts)
    order = np.argsort(-sectors, axis=None)[:_PLACES]
    out = []
    for condition, sector in zip(*np.unravel_index(order, sectors.shape), strict=True):
        out.append(
            {
                **obs.conditions[int(condition)].as_dict(),
                obs.grid.coordinate: obs.grid.between(edges[sector], edges[sector + 1]),
                "residual_rms_um": float(sectors[condition, sector]),
            }
        )
    return tuple(out)


def headline(obs: Observations, residual: Floats) -> str:
    """Describe the systematic residual: direction, harmonic, feed, radius.

    ``residual``, (rows, n): residual of the twin.
    """
    means = condition_means(obs, residual)
    words = []
    parity = _parity(obs, means)
    if parity is not None:
        words.append(f"{parity} in direction")
    power = (to_harmonics(means) ** 2).sum(axis=0)
    by_harmonic = np.bincount(harmonic_numbers(obs.n_bins), power)[: obs.grid.described + 1]
    top = int(np.argmax(by_harmonic))
    share = by_harmonic[top] / max(by_harmonic.sum(), 1e-300)
    words.append(f"{obs.grid.wave(top)} ({100 * share:z.0f} %)" if share > 0.4 else "spread over many harmonics")
    size = 0.5 * np.log(np.maximum((means**2).mean(axis=1), 1e-300))
    for name in obs.conditions[0].swept:
        values = [c.swept[name] for c in obs.conditions]
        if len(set(values)) > 1:
            slope = float(np.polyfit(np.log(values), size, 1)[0])
            words.append(f"{_trend(slope)} with {name}")
    return ", ".join(words)


def _parity(obs: Observations, means: Floats) -> str | None:
    """Compare the sum and the difference of the two directions of a condition."""
    index = {c: i for i, c in enumerate(obs.conditions)}
    even = odd = 0.0
    for condition, i in index.items():
        other = condition.turned
        if condition.sense > 0.0 and other in index:
            even += float(((means[i] + means[index[other]]) ** 2).sum())
            odd += float(((means[i] - means[index[other]]) ** 2).sum())
    if even + odd == 0.0:
        return None
    share = odd / (even + odd)
    return "odd" if share > 0.75 else "even" if share < 0.25 else "mixed"


def _trend(slope: float) -> str:
    return "grows" if slope > 0.3 else "falls" if slope < -0.3 else "does not change"
