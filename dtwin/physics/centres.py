"""Circles whose centre moves from run to run of a set-up, as a ball of a magnet or a machine that warms up lets it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dtwin.physics.whitening import harmonic_numbers, to_harmonics, within_condition
from dtwin.schema import Floats

if TYPE_CHECKING:
    from dtwin.physics.observations import Observations

# So much of what repeats differ by, as mean square, is the centre, and so many times what each of the next harmonics is.
_MOST, _STANDS_OUT = 0.5, 25.0
_NEXT = (2, 5)
_FEWEST = 4
_ROUNDING = 1e-20


def with_own_centres(obs: Observations) -> Observations:
    """Return circles with the centre of each row taken to that of its set-up, if it wanders; see ``Observations.wander_um``.

    A centre that moves evenly with time is a drift, which is an effect.
    """
    wander_um = _wander_um(obs)
    if not wander_um:
        return obs
    basis, y_um = obs.grid.setup, np.empty_like(obs.y_um)
    for row, mask in enumerate(obs.mask):
        y_um[row] = without_centre(obs.y_um[row][:, None], mask, basis)[:, 0]
    # The centre of the set-up stays, for its own sake.
    for setup in range(len(obs.setups)):
        rows = obs.setup_of == setup
        design = np.broadcast_to(basis, (int(rows.sum()), *basis.shape))[obs.mask[rows]]
        y_um[rows] += basis[:, 1:] @ np.linalg.lstsq(design, obs.y_um[rows][obs.mask[rows]], rcond=None)[0][1:]
    return replace(obs.with_y(y_um), wander_um=wander_um)


def without_centre(columns: Floats, mask: NDArray[np.bool_], basis: Floats) -> Floats:
    """Return columns of shape (n, k) without the centre that fits them best, zero where nothing was measured.

    ``basis``, (n, 3): radius and centre.
    """
    fitted = np.linalg.lstsq(basis[mask], columns[mask], rcond=None)[0]
    left = np.where(mask[:, None], columns - basis[:, 1:] @ fitted[1:], 0.0)
    # A centre and nothing else leaves rounding.
    return np.where((left**2).sum(axis=0) > _ROUNDING * (columns**2).sum(axis=0), left, 0.0)


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
