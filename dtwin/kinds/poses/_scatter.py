"""How much readings of each pose scatter: by its own repeats as far as poses differ in it, else by those of all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dtwin.kinds.poses._iso9283 import means_of
from dtwin.schema import Floats
from dtwin.statistics import shared_variances


@dataclass(frozen=True)
class Scatter:
    """Standard deviations of one reading in one direction.

    ``of_reading`` (n,): of the pose of each reading.
    ``dof``: degrees of freedom of all repeats.
    ``dof_of_one``: of what a largest figure hangs on, the scatter of one pose; that of all where poses are alike.
    """

    of_reading: Floats
    dof: float
    dof_of_one: float


def scatter_of(error: Floats, place: Floats, usual: float) -> Scatter:
    """Return the scatter of poses that were measured again.

    Poses far out or fast may scatter more than others. By how much more than chance the mean squares of poses differ tells
    what weight those of a pose have beside that of all (empirical Bayes): none where they differ by chance.

    ``error`` (n, 3), ``place`` (n,): errors of readings, and the numbers of their poses.
    ``usual``: standard deviation of a reading in one direction, of all poses.
    """
    count = np.bincount(place)
    square = np.bincount(place, ((error - means_of(error, place)[place]) ** 2).sum(axis=1))
    dof = np.asarray(3.0 * (count - 1.0), dtype=np.float64)
    own, weight = shared_variances(square / np.maximum(dof, 1.0), dof, usual**2)
    again = dof > 0.0
    of_all = float((count - 1).sum())
    share, of_pose = float(weight[again].mean()), float(np.median(dof[again]))
    return Scatter(np.sqrt(own)[place], of_all, 1.0 / ((1.0 - share) / of_all + share / of_pose))
