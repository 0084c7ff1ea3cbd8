"""Targets that a control measured itself: they jitter about what was commanded."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from dtwin.positioning.assignments import Reading

_CLOSE_MM = 0.01
"""Of an axis that turns, degrees, as all targets here."""
_FARTHER = 20.0
"""Times the width of a group of targets that another group lies off it at least."""


def joined_targets(targets_mm: Iterable[float]) -> dict[float, float]:
    """Return what each target is taken as: those that lie far closer to each other than the others are one, their mean to 0.1 µm."""
    told = np.array(sorted(set(targets_mm)))
    gaps = np.diff(told)
    groups = np.split(told, np.flatnonzero(gaps > _CLOSE_MM) + 1)
    between, width = gaps[gaps > _CLOSE_MM], max((float(np.ptp(g)) for g in groups if g.size), default=0.0)
    if not between.size or width == 0.0 or between.min() < _FARTHER * width:
        return {float(target): float(target) for target in told}
    return {float(target): round(float(group.mean()), 4) for group in groups for target in group}


def with_joined_targets(readings: Sequence[Reading]) -> tuple[Sequence[Reading], float]:
    """Return readings at the targets that were meant, and by how much the others were off them at most.

    Where one sweep was at two that would be one, they are two.
    """
    one = joined_targets(reading[0] for reading in readings)
    joined = [(one[r[0]], *r[1:]) for r in readings]
    if len({r[:3] for r in joined}) < len({r[:3] for r in readings}):
        return readings, 0.0
    return joined, max((abs(target - told) for told, target in one.items()), default=0.0)
