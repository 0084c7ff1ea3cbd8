"""Readings of a positioning test that the others of their target contradict."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dtwin.physics.linear import linear_figures
from dtwin.positioning.matrix import LinearTest
from dtwin.positioning.ways import BOTH
from dtwin.schema import Finding, Floats
from dtwin.statistics import usual_size
from dtwin.units import shown_number

_FEWEST_OF_TARGET = 2
"""Readings, beside the one that is judged, that have to agree; of two cycles one of them is what the other direction tells."""
_FAR = 8.0
"""Robust standard deviations of all readings about those of the other cycles."""
_APART = 5.0
"""How many times a spoilt reading is further off than the others of its target span."""
_BEYOND = 3.0
"""How many times a spoilt reading is further off than the furthest of all targets that have none: heavy tails reach far, but not one far beyond the next."""
_SAME_UM = 1e-4
"""Readings nearer than this are equal: they are differences of positions in mm."""
_MOST_SPOILT = 0.1
"""Share of all readings that may be called spoilt; more is something else."""


@dataclass(frozen=True)
class _SpoiltReading:
    """A reading that the other cycles contradict.

    ``cycle``: from 0.
    ``way``: ``forward`` or ``reverse``.
    ``off_um``: from the median of the other cycles.
    ``span_um``: range of the other cycles.
    """

    target: int
    cycle: int
    way: str
    off_um: float
    span_um: float


def spoilt_readings(test: LinearTest) -> list[_SpoiltReading]:
    """Return the readings that the others of their target contradict, as they stand, else beside what each sweep is off as a whole."""
    cycles = test.forward_um.shape[1]
    if cycles - 1 + (test.ways == BOTH and cycles == _FEWEST_OF_TARGET) < _FEWEST_OF_TARGET:
        return []
    ways = dict(zip(test.ways, (test.forward_um, test.reverse_um), strict=True))
    if contradicted := _contradicted(test, ways):
        return contradicted
    ways = {way: _beside_its_sweep(values) for way, values in ways.items()}
    return [s for s in _contradicted(test, ways) if _stands_alone(ways, s)]


def _stands_alone(ways: Mapping[str, Floats], spoilt: _SpoiltReading) -> bool:
    """Return whether those before and after a reading of its sweep are not off with it: a shift in a sweep leaves a part of it so."""
    off = (ways[spoilt.way] - np.median(_others(ways, spoilt.way), axis=2))[:, spoilt.cycle]
    beside = (
        off[spoilt.target - 1 : spoilt.target + 2 : 2] if 0 < spoilt.target < len(off) - 1 else off[[spoilt.target]]
    )
    return bool(np.all(np.abs(beside) < 0.5 * abs(spoilt.off_um)))


def _beside_its_sweep(values: Floats) -> Floats:
    """Return readings of one direction (targets, cycles) without what each sweep is off by as a whole and in proportion to its place in it.

    Straight lines by the median of slopes between the first half and the second (Theil), which no single reading moves.
    """
    half = len(values) // 2
    if half < 1:
        return values
    off = values - np.median(values, axis=1, keepdims=True)
    slopes = np.median(off[-half:] - off[:half], axis=0) / (len(values) - half)
    lines = np.arange(len(values), dtype=float)[:, None] * slopes
    return np.asarray(values - lines - np.median(off - lines, axis=0))


def _contradicted(test: LinearTest, ways: Mapping[str, Floats]) -> list[_SpoiltReading]:
    """Return the readings far from the others of their target, which agree, and far beyond the furthest of all other targets.

    The limits were chosen on campaigns that only scatter, of 2, 3 and 5 cycles and 11 to 31 targets: noise normal, of Laplace, of Student's t with
    5 degrees of freedom, or normal and of other size from target to target.
    """
    others = {way: _others(ways, way) for way in ways}
    off = {way: values - np.median(others[way], axis=2) for way, values in ways.items()}
    span = {way: np.ptp(of_way, axis=2) for way, of_way in others.items()}
    every = np.concatenate([o.ravel() for o in off.values()])
    # Readings that are rounded agree better than what was read: not to less than a step.
    step = step_um(np.concatenate([test.forward_um, test.reverse_um]))
    limit = _FAR * max(usual_size(every), step / math.sqrt(12.0))
    contradicted = [
        _SpoiltReading(int(i), int(c), way, float(off[way][i, c]), float(span[way][i, c]))
        for way in ways
        for i, c in np.argwhere((np.abs(off[way]) > limit) & (np.abs(off[way]) > _APART * (span[way] + step)))
    ]
    if len(contradicted) > max(2, _MOST_SPOILT * every.size):
        return []
    contradicted.sort(key=lambda spoilt: -abs(spoilt.off_um))
    furthest = np.max([np.abs(o).max(axis=1) for o in off.values()], axis=0)
    while contradicted:
        elsewhere = np.delete(furthest, [s.target for s in contradicted])
        if abs(contradicted[-1].off_um) > _BEYOND * elsewhere.max(initial=0.0):
            break
        contradicted.pop()
    return sorted(contradicted, key=lambda spoilt: (list(ways).index(spoilt.way), spoilt.target, spoilt.cycle))


def step_um(values: Floats) -> float:
    """Return the step to which readings are rounded: the least by which two of them differ."""
    apart = np.diff(np.sort(values, axis=None))
    told = apart[apart > _SAME_UM]
    return float(told.min()) if told.size else 0.0


def spoilt_finding(test: LinearTest) -> Finding | None:
    """Return which readings are spoilt and what they do to the repeatability, None when none is."""
    spoilt = spoilt_readings(test)
    if not spoilt:
        return None
    cycles = test.forward_um.shape[1]
    others = f"the other {cycles - 1}" if cycles > _FEWEST_OF_TARGET else "the other cycle and the other direction"
    told = "; ".join(
        f"cycle {test.cycle(s.cycle)} {s.way} at {test.position_mm[s.target]:g} {test.scale.unit}: {shown_number(s.off_um, sign='+')} {test.scale.fine} from {others}, "
        f"which agree within {shown_number(s.span_um, 2)} {test.scale.fine}"
        for s in spoilt[:6]
    )
    with_all = linear_figures(test.forward_um, test.reverse_um).repeatability_um
    one = len(spoilt) == 1
    return Finding(
        f"{test.scale.kind}.spoilt_readings",
        "error",
        f"{len(spoilt)} reading{'' if one else 's'} {'does' if one else 'do'} not belong to the others ({told}): R is "
        f"{shown_number(with_all, 4)} {test.scale.fine} with {'it' if one else 'them'} and {shown_number(_repeatability_without(test, spoilt), 4)} {test.scale.fine} without; measure "
        "that sweep again, or leave that cycle out",
        {"readings_1": float(len(spoilt)), f"largest_{test.scale.figure}": max(abs(s.off_um) for s in spoilt)},
    )


def _repeatability_without(test: LinearTest, spoilt: Sequence[_SpoiltReading]) -> float:
    """Return R when at each target the cycles with a spoilt reading there are left out."""
    largest = 0.0
    for i in range(len(test.position_mm)):
        bad = {s.cycle for s in spoilt if s.target == i}
        kept = [c for c in range(test.forward_um.shape[1]) if c not in bad]
        if len(kept) > 1:
            part = linear_figures(test.forward_um[[i]][:, kept], test.reverse_um[[i]][:, kept])
            largest = max(largest, part.repeatability_um)
    return largest


def _others(ways: Mapping[str, Floats], way: str) -> Floats:
    """Return what each reading of a direction is judged by, shape (targets, cycles, others): the other cycles.

    Of two cycles also the mean of the other direction, with the median reversal: which of two that differ is wrong, they do not tell.
    """
    values = ways[way]
    cycles = range(values.shape[1])
    others = np.stack([np.delete(values, c, axis=1) for c in cycles], axis=1)
    if len(cycles) > _FEWEST_OF_TARGET:
        return others
    (beside,) = (v.mean(axis=1) for name, v in ways.items() if name != way)
    told = beside + np.median(values.mean(axis=1) - beside)
    return np.concatenate([others, np.broadcast_to(told[:, None, None], others.shape)], axis=2)
