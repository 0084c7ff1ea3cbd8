"""Which logged channel explains what repeats disagree by."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dtwin.physics.effect import Effect
from dtwin.physics.gridding import Indices
from dtwin.physics.observations import SETUP_COLUMNS
from dtwin.physics.problem import Problem
from dtwin.physics.whitening import harmonic_numbers, within_condition
from dtwin.schema import Floats

_ALPHA = 0.004
_DRAWS = 4999
_HIGHEST_HARMONIC = 8


@dataclass(frozen=True)
class Channel:
    """A logged channel that moves with the error inside conditions.

    ``p_value``: by permutation of tests inside conditions, or rotation where few can change places; Holm over all
    channels.
    ``share``: share of the spread between repeats that goes with it.
    ``instead``: channels that would explain the same.
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

    ``problem``: whitened campaign with everything known.

    Only what a channel does *inside* conditions is looked at, so that conditions cannot stand
    for it; alone and times the feed, since a warm machine may err more the faster it moves.
    A bystander that is correlated with the channel found explains nothing more once
    that one is taken out. Five runs of an axis change places in 120 ways only, which can show
    nothing after Holm: where there are fewer orders than are drawn, the channel is compared with
    directions at random among those of the tests (Langsrud 2005), which is exact for normal noise
    of any shape along the path.
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
    others = _Others(problem, of_row, np.random.default_rng(seed))
    ways = np.stack([np.ones(obs.n_rows), obs.feed_mm_s / obs.feed_mm_s.mean()])
    moving: list[Channel] = []
    while channels:
        tested = {name: _test(spread, values, ways, others) for name, values in channels.items()}
        ranked = sorted(tested, key=lambda name: (tested[name][0], -tested[name][1]))
        best = max((n for n in ranked if tested[n][0] == tested[ranked[0]][0]), key=lambda name: tested[name][1])
        p_value = min(1.0, tested[best][0] * len(channels))
        if p_value > _ALPHA:
            break
        chosen = channels.pop(best)
        instead = tuple(name for name, values in channels.items() if _alike(values, chosen))
        moving.append(Channel(best, p_value, tested[best][1], instead))
        for way in ways if np.ptp(ways[1]) > 0.0 else ways[:1]:
            spread = _without(spread, chosen * way)
        others.leave_out(chosen)
        channels = {
            name: _without(values[:, None], chosen)[:, 0] for name, values in channels.items() if name not in instead
        }
    return moving


def with_foreign(problem: Problem, channels: Sequence[Channel], library: Mapping[str, Effect]) -> Problem:
    """Take out what moves with a channel that no effect knows, so that it is not noise."""
    obs = problem.obs
    theta = obs.grid.phase_rad
    waves = [np.ones(obs.n_bins)] + [f(h * theta) for h in range(1, 5) for f in (np.cos, np.sin)]
    for channel in channels:
        if not is_foreign(channel.name, library):
            continue
        values = obs.centred_columns[channel.name]
        columns = np.stack([values * wave for wave in waves], axis=2) * obs.mask[:, :, None]
        whitened = problem.whitened(columns)
        visible, _ = problem.visible(whitened)
        problem = problem.extended(visible, whitened)
    return problem


def is_foreign(name: str, library: Mapping[str, Effect]) -> bool:
    """Tell whether no effect of the library knows a channel."""
    return name != "time_h" and all(name not in effect.needs for effect in library.values())


def _test(spread: Floats, values: Floats, ways: Floats, others: _Others) -> tuple[float, float]:
    """Return p-value and share of the spread; tests keep their runs together.

    The best way for the channel to act counts, as it was measured and as it might have been.
    """
    gram = spread @ spread.T
    largest = max(float(v @ gram @ v / (v @ v)) for v in values * ways)
    might = others.drawn(values)
    drawn = np.zeros(len(might))
    for way in ways:
        v = might * way
        power = np.einsum("di,di->d", v @ gram, v)
        drawn = np.maximum(drawn, power / np.maximum((v**2).sum(axis=1), 1e-300))
    share = largest / max(float(np.trace(gram)), 1e-300)
    # The order that was measured is one of the permutations and must count as one.
    reached = drawn >= largest * (1.0 - 1e-9)
    return float((1 + reached.sum()) / (len(drawn) + 1)), share


class _Others:
    """What a channel might have been, had it nothing to do with the error.

    ``of_row``, (rows,): test of each row.
    """

    def __init__(self, problem: Problem, of_row: Indices, rng: np.random.Generator) -> None:
        self._of_row, self._count = of_row, np.bincount(of_row)
        n, condition_of = len(self._count), problem.obs.condition_of
        # Tests may change places when they were measured under the same conditions.
        members: dict[frozenset[int], list[int]] = {}
        for test in range(n):
            conditions = frozenset(condition_of[of_row == test].tolist())
            members.setdefault(conditions, []).append(test)
        ways = sum(math.lgamma(len(tests) + 1) for tests in members.values())
        self._orders: Indices | None = None
        if ways >= math.log(_DRAWS):
            self._orders = np.tile(np.arange(n), (_DRAWS, 1))
            for tests in members.values():
                self._orders[:, tests] = rng.permuted(np.tile(tests, (_DRAWS, 1)), axis=1)
            return
        self._turned = rng.standard_normal((_DRAWS, n))
        for tests in members.values():
            self._turned[:, tests] -= self._turned[:, tests].mean(axis=1, keepdims=True)

    def drawn(self, values: Floats) -> Floats:
        """Return other values of the tests, shape (draws, rows); inside tests they stay."""
        mean = np.bincount(self._of_row, values) / self._count
        if self._orders is not None:
            other = mean[self._orders]
        else:
            size = np.linalg.norm(self._turned, axis=1, keepdims=True)
            other = self._turned * np.linalg.norm(mean) / np.maximum(size, 1e-300)
        return np.asarray(other[:, self._of_row] + values - mean[self._of_row])

    def leave_out(self, chosen: Floats) -> None:
        """Turn only among the directions that a channel which was found leaves."""
        if self._orders is None:
            mean = np.bincount(self._of_row, chosen) / self._count
            self._turned = _without(self._turned.T, mean).T


def _alike(values: Floats, chosen: Floats) -> bool:
    cosine = values @ chosen / np.sqrt((values @ values) * (chosen @ chosen))
    return abs(float(cosine)) > 0.97


def _without(values: Floats, chosen: Floats) -> Floats:
    return np.asarray(values - np.outer(chosen, chosen @ values) / (chosen @ chosen))
