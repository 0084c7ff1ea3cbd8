"""What thermal models of error motions leave of a campaign."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dtwin.kinds.volumetric._identify import Balls
from dtwin.kinds.volumetric._thermal_model import ThermalModel
from dtwin.kinds.volumetric.session import Session
from dtwin.schema import Floats


def predicted(models: Sequence[ThermalModel], measured: Session) -> Floats:
    """Return the error motions that the models expect, in free run, shape (cycles, coefficients)."""
    return np.column_stack([model.run(measured.rise_of(model.sensors)) for model in models])


def distance_changes_um(where: Balls, moved_um: Floats) -> Floats:
    """Return how the distances between balls of the same pose change, shape (pairs,).

    ``moved_um``, (n, 3): how the tool point moves there.
    """
    changes_um = []
    for pose in sorted(set(where.pose.tolist()) - {0}):
        rows = np.flatnonzero(where.pose == pose)
        one, other = np.triu_indices(len(rows), 1)
        apart = where.position_mm[rows][one] - where.position_mm[rows][other]
        unit = apart / np.linalg.norm(apart, axis=1)[:, None]
        changes_um.append(((moved_um[rows][one] - moved_um[rows][other]) * unit).sum(axis=1))
    return np.concatenate(changes_um)


def changes_left_um(measured: Session, expected: Floats) -> list[Floats]:
    """Return what is left of the changes of distances between balls, cycle by cycle, shape (pairs,) each.

    ``expected``, (cycles, coefficients): error motions that are taken off.
    """
    return [
        distance_changes_um(where, moved - measured.artefact.predicted_um(where, values))
        for (where, moved), values in zip(measured.moved, expected, strict=True)
    ]
