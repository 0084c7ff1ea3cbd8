"""Positioning tests made again: what runs differ by as wholes, and what readings of one target scatter by."""

from __future__ import annotations

import numpy as np

from dtwin.positioning.matrix import LinearTest
from dtwin.schema import Floats
from dtwin.statistics import shared_variances, times_simulated


def made_again(test: LinearTest, *, one_way: bool = False) -> tuple[Floats, Floats, float]:
    """Return readings of tests like this one, forward and reverse, (tests, targets, runs) each, and the degrees of freedom.

    A run differs from the others by a shift and a stretch of all its readings, as by warming, and by the scatter of each
    reading. A shift that all targets of a run share makes R no less certain than that of one target, and moves no range of
    means: drawn target by target it would count for the one too little and for the other too much.

    ``one_way``: whether both directions are the same readings.
    """
    rng = np.random.default_rng(0)
    ways = [test.forward_um] if one_way else [test.forward_um, test.reverse_um]
    every = np.concatenate(ways)
    mean = every.mean(axis=1, keepdims=True)
    moved = every - mean
    along = _along(test.position_mm, len(ways))
    size, rest = _wholes(moved, along)
    runs = every.shape[1]
    scatter, own = _scatter(rest, along.shape[1])
    if not one_way:
        mean = _calm(mean, 2.0 * float(scatter.mean()) / runs)
    count = times_simulated(every.size)
    drawn = mean + np.sqrt(scatter)[:, None] * rng.standard_normal((count, *every.shape))
    drawn = drawn + along @ (size[:, None] * rng.standard_normal((count, along.shape[1], runs)))
    parts = np.split(drawn, len(ways), axis=1)
    whole = float((along**2 @ size**2).mean())
    share = whole / max(whole + float(scatter.mean()), 1e-12)
    of_all = len(every) - along.shape[1]
    of_scatter = (1.0 - own) / of_all + own / min(len(ways), of_all)
    return parts[0], parts[-1], (runs - 1.0) / (share**2 + (1.0 - share) ** 2 * of_scatter)


def _calm(mean: Floats, chance: float) -> Floats:
    """Return means (readings, 1), forward before reverse, whose reversals differ as much as those of the axis surely do.

    About means as they are, the largest reversal would stand out twice: by its own scatter, and by what is drawn.

    ``chance``: variance of a reversal by the scatter of readings.
    """
    forward, reverse = np.split(mean, 2)
    reversal = reverse - forward
    differ = float(reversal.var(ddof=1)) if len(reversal) > 1 else 0.0
    kept = np.sqrt(max(0.0, 1.0 - chance / differ)) if differ > 0.0 else 1.0
    less = (1.0 - kept) * (reversal - reversal.mean()) / 2.0
    return np.concatenate([forward + less, reverse - less])


def _along(position_mm: Floats, ways: int) -> Floats:
    """Return what a shift and a stretch of a run do to its readings, (readings, 2); fewer columns of few readings."""
    half = max(float(np.ptp(position_mm)) / 2.0, 1e-9)
    stretch = (position_mm - position_mm.mean()) / half
    columns = np.stack([np.ones(len(position_mm)), stretch], axis=1)[:, : max(len(position_mm) * ways - 1, 0)]
    return np.tile(columns[:, : 1 if len(position_mm) < 3 else 2], (ways, 1))


def _wholes(moved: Floats, along: Floats) -> tuple[Floats, Floats]:
    """Return the standard deviations of shift and stretch, without what scatter adds to them, and what they leave."""
    runs = moved.shape[1]
    if not along.shape[1]:
        return np.zeros(0), moved
    told = np.linalg.pinv(along)
    found = told @ moved
    rest = moved - along @ found
    scatter = float((rest**2).sum()) / ((len(moved) - along.shape[1]) * (runs - 1))
    variance = (found**2).sum(axis=1) / (runs - 1) - scatter * (told**2).sum(axis=1)
    return np.sqrt(np.maximum(variance, 0.0)), rest


def _scatter(rest: Floats, columns: int) -> tuple[Floats, float]:
    """Return the variance of each target and direction, as far as they surely differ, and the weight of a target's own."""
    readings, runs = rest.shape
    lost = readings / (readings - columns)
    own = lost * (rest**2).sum(axis=1) / (runs - 1)
    shared, weight = shared_variances(own, np.full(readings, runs - 1.0), float(own.mean()))
    return shared, float(weight.mean())
