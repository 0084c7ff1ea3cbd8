"""Which logged channel explains what repeats disagree by."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dtwin.physics.gridding import Indices
from dtwin.physics.observations import SETUP_COLUMNS
from dtwin.physics.problem import Problem
from dtwin.physics.whitening import harmonic_numbers, within_condition
from dtwin.schema import Floats

ALPHA = 0.004
_DRAWS = 4999
_HIGHEST_HARMONIC = 8


@dataclass(frozen=True)
class Channel:
    """A logged channel that moves with the error inside conditions.

    Attributes
    ----------
    name : str
        Column, with unit.
    p_value : float
        By permutation of tests inside conditions, Holm over all channels.
    share : float
        Share of the spread between repeats that goes with it.
    instead : tuple of str
        Channels that would explain the same.
    """

    name: str
    p_value: float
    share: float
    instead: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, object]:
        """Return a JSON-ready mapping."""
        return {**vars(self), "instead": list(self.instead)}


def screen_channels(problem: Problem, seed: int) -> list[Channel]:
    """Return the logged channels that explain the spread between repeats.

    Parameters
    ----------
    problem : Problem
        Whitened campaign with everything known.
    seed : int
        Seed of the permutations.

    Notes
    -----
    Only what a channel does *inside* conditions is looked at, so that conditions cannot stand
    for it; alone and times the feed, since a warm machine may err more the faster it moves.
    A bystander that is correlated with the channel found explains nothing more once
    that one is taken out.
    """
    obs = problem.obs
    low = (harmonic_numbers(obs.n_bins) <= _HIGHEST_HARMONIC) & (problem.weights > 0)
    spread, count = within_condition(problem.residual[:, low], obs.condition_of)
    channels = {}
    for name in (n for n in obs.logged if not n.startswith(SETUP_COLUMNS)):
        per_run = obs.centred_columns[name].mean(axis=1)
        inside, _ = within_condition(per_run[:, None], obs.condition_of)
        if np.ptp(inside) > 1e-9 * max(1.0, float(np.abs(per_run).max())):
            channels[name] = inside[:, 0]
    if not channels or (count > 1).sum() < 8:
        return []
    _, of_row = np.unique(obs.clusters, return_inverse=True)
    orders = _orders(problem, of_row, np.random.default_rng(seed))
    ways = np.stack([np.ones(obs.n_rows), obs.feed_mm_s / obs.feed_mm_s.mean()])
    found: list[Channel] = []
    while channels:
        tested = {
            name: _test(spread, values, ways, orders, of_row) for name, values in channels.items()
        }
        ranked = sorted(tested, key=lambda name: (tested[name][0], -tested[name][1]))
        best = max(
            (n for n in ranked if tested[n][0] == tested[ranked[0]][0]),
            key=lambda name: tested[name][1],
        )
        p_value = min(1.0, tested[best][0] * len(channels))
        if p_value > ALPHA:
            break
        chosen = channels.pop(best)
        instead = tuple(name for name, values in channels.items() if _alike(values, chosen))
        found.append(Channel(best, p_value, tested[best][1], instead))
        for way in ways if np.ptp(ways[1]) > 0.0 else ways[:1]:
            spread = _without(spread, chosen * way)
        channels = {
            name: _without(values[:, None], chosen)[:, 0]
            for name, values in channels.items()
            if name not in instead
        }
    return found


def _test(
    spread: Floats, values: Floats, ways: Floats, orders: Indices, of_row: Indices
) -> tuple[float, float]:
    """Return p-value and share of the spread; tests keep their runs together.

    The best way for the channel to act counts, in the order measured as in every other order.
    """
    gram = spread @ spread.T
    mean = np.bincount(of_row, values) / np.bincount(of_row)
    shuffled = mean[orders][:, of_row] + values - mean[of_row]
    found = max(float(v @ gram @ v / (v @ v)) for v in values * ways)
    drawn = np.zeros(len(orders))
    for way in ways:
        v = shuffled * way
        power = np.einsum("di,di->d", v @ gram, v)
        drawn = np.maximum(drawn, power / np.maximum((v**2).sum(axis=1), 1e-300))
    share = found / max(float(np.trace(gram)), 1e-300)
    # The order that was measured is one of the permutations and must count as one.
    reached = drawn >= found * (1.0 - 1e-9)
    return float((1 + reached.sum()) / (len(drawn) + 1)), share


def _orders(problem: Problem, of_row: Indices, rng: np.random.Generator) -> Indices:
    """Draw permutations of the tests inside each condition, shape (draws, tests)."""
    obs = problem.obs
    # Tests may change places when they were measured under the same conditions.
    members: dict[frozenset[int], list[int]] = {}
    for test in range(int(of_row.max()) + 1):
        conditions = frozenset(obs.condition_of[of_row == test].tolist())
        members.setdefault(conditions, []).append(test)
    out = np.tile(np.arange(int(of_row.max()) + 1), (_DRAWS, 1))
    for tests in members.values():
        out[:, tests] = rng.permuted(np.tile(tests, (_DRAWS, 1)), axis=1)
    return out


def _alike(values: Floats, chosen: Floats) -> bool:
    cosine = values @ chosen / np.sqrt((values @ values) * (chosen @ chosen))
    return abs(float(cosine)) > 0.97


def _without(values: Floats, chosen: Floats) -> Floats:
    return np.asarray(values - np.outer(chosen, chosen @ values) / (chosen @ chosen))
