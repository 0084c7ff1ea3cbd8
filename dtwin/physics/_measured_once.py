"""Runs that were measured once: their noise is bounded from within."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dtwin.physics._score import HIGHEST_HARMONIC
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Term, unweighted
from dtwin.physics.whitening import harmonic_numbers

_COPIES = 3
# Median of the square of a standard normal variable.
_MEDIAN_SQUARE = 0.4549


def as_if_repeated(obs: Observations, known: Sequence[Term], seed: int) -> tuple[Observations, float] | None:
    """Return circles as if each had been repeated, and the least noise that they can have.

    The noise is that of the harmonics above 60, where hardly any effect of a machine lives; by the
    median, for a spike has some of them. Low harmonics repeat less well than that: what comes out
    looks like an effect, and is not confirmed.

    ``obs``: runs, none of which was repeated.
    Returns ``obs``: three copies of every run. Their mean is the run, and the variance of their mean is that of the
    noise.
    Returns ``floor_um``: RMS of the noise of one run.
    """
    high = harmonic_numbers(obs.n_bins) > HIGHEST_HARMONIC
    if not obs.grid.in_plane or not high.any():
        return None
    rows = unweighted(obs, known).residual
    floor_um = float(np.sqrt(np.median(rows[:, high] ** 2) / _MEDIAN_SQUARE))
    noise = np.random.default_rng(seed).standard_normal((_COPIES, *rows.shape))
    noise = (noise - noise.mean(axis=0)) * floor_um * np.sqrt(_COPIES)
    copies = obs.take(np.tile(np.arange(obs.n_rows), _COPIES))
    runs = int(obs.run_of.max()) + 1
    run_of = np.concatenate([obs.run_of + runs * copy for copy in range(_COPIES)])
    changed = copies.y_um + noise.reshape(copies.y_um.shape)
    return replace(copies, run_of=run_of).with_y(changed), floor_um
