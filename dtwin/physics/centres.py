"""Circles whose centre moves from run to run of a set-up, as a ball of a magnet or a machine that warms up lets it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from dtwin.physics.whitening import CENTRE, from_harmonics, harmonic_numbers, to_harmonics, within_condition
from dtwin.schema import Floats

if TYPE_CHECKING:
    from dtwin.physics.observations import Observations

# So much of what repeats differ by, as mean square, is the centre, and so many times what each of the next harmonics is.
_MOST, _STANDS_OUT = 0.5, 25.0
_NEXT = (2, 5)
_FEWEST = 4


def with_own_centres(obs: Observations) -> Observations:
    """Return circles with the centre of each row taken to that of its set-up, if it wanders; see ``Observations.wander_um``.

    A centre that moves evenly with time is a drift, which is an effect.
    """
    wander_um = _wander_um(obs)
    if not wander_um:
        return obs
    rows = to_harmonics(obs.y_um)
    own = rows - without_centre(rows)
    # The centre of the set-up stays, for its own sake.
    of_setup = np.stack([own[obs.setup_of == setup].mean(axis=0) for setup in range(len(obs.setups))])
    return replace(obs.with_y(from_harmonics(rows - own + of_setup[obs.setup_of])), wander_um=wander_um)


def without_centre(rows: Floats) -> Floats:
    """Return rows of harmonics of whole circles, shape (k, n, ...), without harmonic 1."""
    return np.concatenate([rows[:, :1], np.zeros_like(rows[:, CENTRE]), rows[:, CENTRE.stop :]], axis=1)


def _wander_um(obs: Observations) -> float:
    """Return by how much the centre moves between repeats beside an even drift, RMS; 0 where it is not most of all."""
    inside, count = within_condition(to_harmonics(obs.y_um), obs.condition_of)
    repeated = count > 1
    if not obs.mask.all() or repeated.sum() - len(set(obs.condition_of[repeated].tolist())) < _FEWEST:
        return 0.0
    time_h = np.array([float(np.mean(c["time_h"])) for c in obs.columns])
    passed_h, _ = within_condition(np.stack([time_h, time_h**2], axis=1), obs.condition_of)
    inside -= passed_h @ np.linalg.lstsq(passed_h, inside, rcond=None)[0]
    power = np.bincount(harmonic_numbers(obs.n_bins), (inside[repeated] ** 2).mean(axis=0))
    centre, beside = power[1], power[_NEXT[0] : _NEXT[1]].mean()
    wanders = centre > _MOST * power[1:].sum() and centre > _STANDS_OUT * beside
    return float(np.sqrt(centre / obs.n_bins)) if wanders else 0.0
