"""Gain of a candidate on conditions that were left out of the fit."""

from __future__ import annotations

import numpy as np

from dtwin.physics.problem import Problem
from dtwin.physics.whitening import from_harmonics
from dtwin.schema import Floats

_RIDGE = 1e-9
_MOST_PLACES = 150
_IN_ONE = 0.99
"""Share of its squares that a column has in the one condition in which it acts."""


def left_out_gain(problem: Problem, whitened: Floats) -> float:
    """Return the mean relative gain on left-out conditions.

    ``problem``: whitened campaign with everything known.
    ``whitened``, (rows * n, k): columns of the candidate.
    Returns 1 when the residual vanishes, below zero when the candidate makes it worse. A whole (plane, radius, feed)
    is left out at a time, or a run where a number of the candidate acts in one of them only, as a leaning axis does in
    its plane: no other foretells that. Centre and radius come from the other runs of the set-up. What is known and acts in
    what is left out alone, as a set-up or a bend in its plane, is fitted to it.
    """
    obs = problem.obs
    groups, power = obs.place_of, (whitened**2).reshape(obs.n_rows, obs.n_bins, -1).sum(axis=1)
    acts = np.array([power[groups == place].sum(axis=0) for place in range(int(groups.max()) + 1)])
    among = np.ones(obs.n_rows, dtype=np.bool_)
    if (acts.max(axis=0) > _IN_ONE * acts.sum(axis=0)).any():
        groups, among = obs.run_of, acts.sum(axis=1)[groups] > 0.0
    size = np.sqrt((whitened**2).sum(axis=0))
    both = np.concatenate([problem.raw, whitened / np.where(size > 0, size, 1.0)], axis=1)
    columns = both.reshape(obs.n_rows, obs.n_bins, -1)
    y = problem.y.reshape(obs.n_rows, obs.n_bins)
    names = sorted(set(groups.tolist()))
    asked = set(groups[among].tolist())
    grams = np.array([_gram(columns[groups == g], columns[groups == g]) for g in names])
    rights = np.array([_gram(columns[groups == g], y[groups == g][:, :, None]) for g in names])
    gains = []
    for number, group in enumerate(names):
        if group not in asked:
            continue
        gram, right = grams.sum(axis=0) - grams[number], rights.sum(axis=0) - rights[number]
        own = np.flatnonzero(np.diag(gram)[: problem.raw.shape[1]] <= 0.0)
        left = []
        for k in (problem.raw.shape[1], columns.shape[2]):
            fitted = _solved(gram[:k, :k], right[:k, 0])
            rest = y[groups == group] - columns[groups == group][:, :, :k] @ fitted
            left.append(_without(rest, columns[groups == group][:, :, own]))
        gains.append((left[0] - left[1]) / max(left[0], 1e-300))
    return float(np.mean(gains))


def left_out_places(problem: Problem, whitened: Floats) -> float:
    """Return the relative gain on places along an axis that were left out one after the other; infinite for many places.

    What has almost as many numbers as there are places draws a curve through them, and foretells none of them.

    ``problem``: campaign without weights, with everything known.
    ``whitened``, (rows * n, k): columns of the candidate, without weights.
    """
    obs = problem.obs
    if not obs.there_and_back or obs.n_bins > _MOST_PLACES:
        return np.inf
    size = np.sqrt((whitened**2).sum(axis=0))
    both = np.concatenate([problem.raw, whitened / np.where(size > 0, size, 1.0)], axis=1)
    columns = from_harmonics(both.reshape(obs.n_rows, obs.n_bins, -1))
    y = from_harmonics(problem.y.reshape(obs.n_rows, obs.n_bins))
    grams = np.einsum("nqj,nqk->qjk", columns, columns)
    rights = np.einsum("nqj,nq->qj", columns, y)
    left = []
    for k in (problem.raw.shape[1], columns.shape[2]):
        gram, right = grams.sum(axis=0)[:k, :k], rights.sum(axis=0)[:k]
        fitted = [_solved(gram - own[:k, :k], right - side[:k]) for own, side in zip(grams, rights, strict=True)]
        left.append(float(((y - np.einsum("nqk,qk->nq", columns[:, :, :k], np.array(fitted))) ** 2).sum()))
    return (left[0] - left[1]) / max(left[0], 1e-300)


def _gram(a: Floats, b: Floats) -> Floats:
    return np.asarray(np.tensordot(a, b, axes=([0, 1], [0, 1])))


def _solved(gram: Floats, right: Floats) -> Floats:
    ridge = _RIDGE * float(np.trace(gram)) * np.eye(len(gram))
    return np.asarray(np.linalg.solve(gram + ridge, right))


def _without(rest: Floats, own: Floats) -> float:
    """Return the sum of squares of what is left out, once it has its own centre, radius, and what else acts there alone."""
    used = own.reshape(rest.size, own.shape[2])
    used = used[:, (used**2).sum(axis=0) > 0]
    if not used.shape[1]:
        return float((rest**2).sum())
    basis = np.linalg.qr(used)[0]
    return float((rest**2).sum() - ((basis.T @ rest.ravel()) ** 2).sum())
