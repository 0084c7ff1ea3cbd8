"""Drift of pose accuracy and repeatability after ISO 9283: by how much both change while the poses are measured again."""

from __future__ import annotations

import numpy as np

from dtwin.schema import Floats
from dtwin.statistics import shared_variances, times_simulated

# Readings of a pose of which one accuracy and one repeatability are computed, to see them change.
_CYCLES = 10


def changes_of(error_um: Floats, place: Floats) -> tuple[float, float] | None:
    """Return dAP and dRP of errors (n, 3), in the order of measurement, of poses with these numbers.

    None where no pose was measured twenty times. Each is the largest change since the first ten readings of a pose.
    """
    told = [_largest(*_figures(blocks)) for blocks in _blocks(error_um, place)]
    return (float(max(a for a, _ in told)), float(max(r for _, r in told))) if told else None


def uncertainty_of_changes(error_um: Floats, place: Floats) -> tuple[tuple[float, float], float]:
    """Return standard uncertainties of dAP and dRP, and their degrees of freedom, of poses that changes_of() takes.

    The test is simulated again with what surely changed and what scatters within ten readings. How far dAP and dRP
    of 95 of 100 such tests are from what was put in, is twice the uncertainty: a largest change is too large where
    little changes.
    """
    poses = _blocks(error_um, place)
    means = [blocks.mean(axis=1) for blocks in poses]
    square = np.concatenate([blocks.var(axis=1, ddof=1).mean(axis=-1) for blocks in poses])
    dof = np.full(square.size, 3.0 * (_CYCLES - 1))
    # All poses may scatter more at first, while the robot warms: a pose is compared with the others of that time.
    ten, own = np.concatenate([np.arange(len(m)) for m in means]), np.empty_like(square)
    for now in (ten == n for n in range(int(ten.max()) + 1)):
        own[now], _ = shared_variances(square[now], dof[now], float(square[now].mean()))
    # What means of ten differ by without any drift, and what they do: the rest is drift.
    away = [m - m.mean(axis=0) for m in means]
    chance = float(square.mean()) / _CYCLES * sum(3.0 * (len(m) - 1) for m in means)
    apart = sum(float((a**2).sum()) for a in away)
    weight = 1.0 - chance / apart if apart > chance else 0.0
    rng = np.random.default_rng(0)
    times = times_simulated(sum(blocks.size for blocks in poses))
    scatter_um = np.split(np.sqrt(own), np.cumsum([len(m) for m in means])[:-1])
    true, again = [], []
    for mean, off, one_um in zip(means, away, scatter_um, strict=True):
        steady = mean - (1.0 - weight) * off
        noise = one_um[:, None, None] * rng.standard_normal((times, len(mean), _CYCLES, 3))
        accuracy, repeatability = _figures(steady[:, None] + noise)
        again.append(_largest(accuracy, repeatability))
        true.append(_largest(np.linalg.norm(steady, axis=-1), repeatability.mean(axis=0)))
    off_by = np.abs(np.max(again, axis=0) - np.max(true, axis=0)[:, None])
    accuracy_um, repeatability_um = (np.quantile(off_by, 0.95, axis=1) / 2.0).tolist()
    return (accuracy_um, repeatability_um), float(dof.sum())


def _blocks(error_um: Floats, place: Floats) -> list[Floats]:
    """Return the errors of each pose that was measured twenty times, ten readings after ten: (tens, 10, 3)."""
    often = np.flatnonzero(np.bincount(place) >= 2 * _CYCLES)
    of_poses = (error_um[place == pose] for pose in often)
    return [one[: len(one) // _CYCLES * _CYCLES].reshape(-1, _CYCLES, 3) for one in of_poses]


def _figures(blocks: Floats) -> tuple[Floats, Floats]:
    """Return AP and RP (..., tens) of readings (..., tens, 10, 3)."""
    means = blocks.mean(axis=-2)
    away = np.linalg.norm(blocks - means[..., None, :], axis=-1)
    return np.linalg.norm(means, axis=-1), away.mean(axis=-1) + 3.0 * away.std(axis=-1, ddof=1)


def _largest(accuracy: Floats, repeatability: Floats) -> tuple[Floats, Floats]:
    """Return the largest changes of both (..., tens) since the first ten readings: (...)."""
    first, second = (np.abs(one - one[..., :1]).max(axis=-1) for one in (accuracy, repeatability))
    return first, second
