"""A handful of runs that go there and back: what of a column differs between them, and what wanders."""

from __future__ import annotations

import numpy as np

from dtwin.physics.observations import Observations
from dtwin.physics.problem import Problem, orthonormal
from dtwin.schema import Floats

_BOWS = 4
_ROUNDING = 1e-12


def smooth_share(problem: Problem, z: Floats) -> float:
    """Return the share of columns that is a line or a bow along the axis, each way."""
    obs = problem.obs
    place = np.linspace(-1.0, 1.0, obs.n_bins)
    parts = [
        np.outer(sense, place**power) * obs.mask for power in range(_BOWS) for sense in (np.ones(obs.n_rows), obs.sense)
    ]
    smooth, _ = problem.visible(problem.whitened(np.stack(parts, axis=2)))
    return float(((smooth.T @ z) ** 2).sum() / max(z.shape[1], 1))


def inside(visible: Floats, obs: Observations) -> Floats:
    """Return what columns do between repeats, orthonormal.

    Time passes along a sweep as well: what the sweeps have in common would be taken for drift.
    """
    z = visible.reshape(obs.n_rows, -1)
    mean = np.array([z[obs.condition_of == c].mean(axis=0) for c in range(len(obs.conditions))])
    moving = (z - mean[obs.condition_of]).reshape(visible.shape)
    # The columns have length one: of what is the same in all runs only rounding is left.
    return orthonormal(moving[:, (moving**2).sum(axis=0) > _ROUNDING])


def along(column: Floats, deviation: Floats, obs: Observations) -> Floats:
    """Return what each run has of the form that a column has in all runs, shape (runs,)."""
    shape = int(obs.run_of.max()) + 1, len(obs.conditions), obs.n_bins
    forms, amounts = np.zeros(shape), np.zeros(shape)
    forms[obs.run_of, obs.condition_of] = column
    amounts[obs.run_of, obs.condition_of] = deviation
    form = np.linalg.svd(forms.reshape(shape[0], -1), full_matrices=False)[2][0]
    return np.asarray(amounts.reshape(shape[0], -1) @ form)
