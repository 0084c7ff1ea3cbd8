"""What moves from cycle to cycle of a positioning test: its zero."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from dtwin.positioning._spoilt import spoilt_readings, step_um
from dtwin.positioning.matrix import LinearTest
from dtwin.schema import Finding, Floats
from dtwin.statistics import f_tail, usual_size
from dtwin.units import shown_number

_FEWEST_CYCLES = 4
"""Cycles that tell how a zero moves."""
_FEWEST_ALIKE = 3
"""Cycles whose exact zero is no chance."""
_TAUS = (0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 5.6)
"""Time constants of warming that are tried, in cycles."""
_WORTH = 0.5
"""Share of the variance between cycles that a description must take to be told."""
_LITTLE = 0.02
"""Share of the variance that a description may leave, though it is no noise: no zero stands still to a tenth of a micrometre beside an axis that warms."""
_CHANCE = 1e-3
"""How often a description of readings that only scatter may be as good (F test)."""
_MOST_WARMER_K = 15.0
"""What an axis warms by in a test; a stretch that needs more is not called heat."""
ORDINARY = 1.0
"""What a zero wanders by in µm, or in seconds of arc (1 µm at 200 mm), without any fault.

Of a metre of travel, 1 K of air is 1 µm, and 0.1 K of steel, too; a count of an encoder at the motor, or a step, is about 1 µm or more.
"""
_BETWEEN = "cycle to cycle"
_HELD = 3
"""Readings that a jump lasts at least; what is over sooner is a spoilt reading."""
_MOST_JUMPS = 20
_MOST_TIMES = 400
# A zero is off by so many times what readings differ by.
_MANY_TIMES = 2.0


def shifted_zero(test: LinearTest) -> Finding | None:
    """Return that all readings are off by the same, many times what they differ by; None where they are not."""
    every = np.concatenate([test.forward_um, test.reverse_um], axis=1)
    if not every.size:
        return None
    shift, spread = float(np.mean(every)), float(np.ptp(every))
    if abs(shift) < _MANY_TIMES * spread:
        return None
    fine = test.scale.fine
    said = (
        f"all readings are off by {shift:+z.1f} {fine}, alike to within {shown_number(spread)} {fine}: a datum, the zero of instrument or axis; "
        "the figures of ISO 230-2 do not count it, and it is no error of positioning"
    )
    return Finding(
        f"{test.scale.kind}.datum",
        "info",
        said,
        {f"shift_{test.scale.figure}": shift, f"spread_{test.scale.figure}": spread},
    )


def zero_of_each_cycle(test: LinearTest) -> Finding | None:
    """Return that every cycle reads exactly 0 at one target, where the others scatter: the instrument was set to zero there each time."""
    ways = list(dict.fromkeys(test.ways))
    values = np.stack([test.forward_um, test.reverse_um][: len(ways)])
    if values.shape[2] < _FEWEST_ALIKE:
        return None
    zero = (values == 0.0).all(axis=2)
    targets = np.flatnonzero(zero.any(axis=0))
    others = np.ptp(np.delete(values, targets, axis=1), axis=2)
    if targets.size != 1 or not others.size or not (others > 0.0).all():
        return None
    at = f"{' and '.join(way for way, there in zip(ways, zero[:, targets[0]], strict=True) if there)} at {test.position_mm[targets[0]]:g} {test.scale.unit}"
    said = (
        f"every cycle reads exactly 0 {at}: the instrument was set to zero there in each cycle; that is a datum, no accuracy: a zero that moves "
        "from cycle to cycle (slip, lost steps) is not in the table, and what that one reading scatters by is in all others"
    )
    return Finding(
        f"{test.scale.kind}.zeroed", "warning", said, {test.scale.position: float(test.position_mm[targets[0]])}
    )


@dataclass(frozen=True)
class _MovingZero:
    """How readings move from cycle to cycle.

    ``shift_um`` (ways, targets, cycles): from the first reading, of what settles from where it settles to; slip is taken for steady.
    """

    finding: Finding
    shift_um: Floats


def moving_zero(test: LinearTest) -> _MovingZero | None:
    """Return how readings move from cycle to cycle: by jumps, steadily, or as something that warms; None when they do not.

    The first sweep of each direction tells what belongs to the targets; the rest is described by a shift that grows by the
    same amount each cycle (slip), one shift or several at any reading (lost steps), or a shift and a stretch that settle (warming;
    settling where heat hardly stretches as much). Schwarz's criterion chooses, an F test guards; spoilt readings are left out.
    """
    cycles = test.forward_um.shape[1]
    if cycles < _FEWEST_CYCLES:
        return None
    ways = list(dict.fromkeys(test.ways))
    values = np.stack([test.forward_um, test.reverse_um][: len(ways)])
    for s in spoilt_readings(test):
        values[ways.index(s.way), s.target, s.cycle] = np.nan
    moved = values - np.nanmean(values, axis=2, keepdims=True)
    told = np.isfinite(moved)
    total, n = float(np.nansum(moved**2)), int(told.sum())
    if total <= 0.0:
        return None
    place = (test.position_mm - test.position_mm.mean()) / max(float(np.ptp(test.position_mm)), 1e-9)
    cycle = np.arange(cycles, dtype=float)

    def left(columns: Sequence[Floats]) -> tuple[Floats, Floats]:
        # Like the readings, columns are told from their mean over the cycles; normal equations, as readings may be a million.
        design = np.empty((len(columns), n))
        for row, column in zip(design, columns, strict=True):
            spread = np.broadcast_to(column, moved.shape)
            row[:] = (spread - spread.mean(axis=2, keepdims=True))[told]
        solution, *_ = np.linalg.lstsq(design @ design.T, design @ moved[told], rcond=None)
        rest = np.full(moved.shape, np.nan)
        rest[told] = moved[told] - solution @ design
        return rest, np.asarray(solution)

    best: list[tuple[float, Floats, str, Callable[[], str], Floats, int, Sequence[Floats]]] = []

    def tried(name: str, where: Callable[[], str], columns: Sequence[Floats], searched: int) -> float:
        rest, sizes = left(columns)
        many = len(columns) + searched
        cost = float(n * np.log(max(float(np.nansum(rest**2)), 1e-12) / n) + many * np.log(n))
        if not best or cost < best[0][0]:
            best[:] = [(cost, rest, name, where, sizes, many, columns)]
        return cost

    share = (np.arange(len(place)) + 0.5) / (len(ways) * len(place))
    orders = {"forward": np.stack([share, 1.0 - share]), "reverse": np.stack([0.5 + share, 0.5 - share])}
    if len(ways) == 1:
        orders = {ways[0]: (share if ways[0] == "forward" else 1.0 - share)[None, :]}
    # Whether it slips within cycles, too, no reading tells; most that slips does, at every move.
    tried("slip", str, [orders[test.first or ways[0]][:, :, None] + cycle], 0)
    between = [(cycle >= at).astype(float) for at in range(1, cycles)]
    tried("jumps", lambda: _BETWEEN, between, 0)
    for number, step in enumerate(between, start=1):
        tried("jump", partial("cycle {}".format, test.cycle(number)), [step], 1)
    for way in [test.first] if test.first else list(orders):
        within = orders[way][:, :, None] + cycle
        # The best of many places fits by chance: a place counts as three parameters.
        for at in _jumps(within, moved, told):
            steps = [(within >= time).astype(float) for time in at]
            name = "jump" if len(at) == 1 else "jumps" if len(at) < cycles else "wander"
            tried(name, partial(_places, at, within, test), steps, 3 * len(at))
        # What moves within sweeps, too, is no jump: straight lines from the beginning of one cycle to that of the next.
        tried("wander", str, [np.clip(1.0 - np.abs(within - knot), 0.0, None) for knot in range(1, cycles + 1)], 0)

        def warmed(tau: float, within: Floats = within) -> float:
            settling = -np.exp(-within / tau)
            return tried("warming", partial(shown_number, tau, 2), [settling, settling * place[None, :, None]], 1)

        # Where readings move by much more than they scatter, a time constant between two of the list leaves what looks like another law.
        nearest = min(_TAUS, key=warmed)
        minimize_scalar(
            lambda log, warmed=warmed: warmed(float(np.exp(log))),
            bounds=(np.log(nearest / 1.5), np.log(nearest * 1.5)),
            method="bounded",
        )
    ((_, rest, name, place_of, sizes, many, columns),) = best
    kept = float(np.nansum(rest**2))
    # Each target and direction has its mean.
    free = n - len(ways) * len(place) - many
    ratio = (total - kept) / many / max(kept, 1e-12) * free
    little = 1.0 - kept / total < _WORTH or free < 1 or f_tail(ratio, (many, free)) > _CHANCE
    if little or name not in _SAID or (kept > _LITTLE * total and _wanders(rest)):
        return None
    where = place_of()
    moves = ", ".join(shown_number(size, sign="+") for size in sizes)
    stretch = test.scale.stretch * max(float(np.ptp(test.position_mm)), 1e-9)
    warmer_k = 1000.0 * abs(float(sizes[-1])) / stretch if stretch else math.inf
    if name == "warming" and warmer_k > _MOST_WARMER_K:
        name = "settling"
    shift = np.sum([size * np.broadcast_to(c, moved.shape) for size, c in zip(sizes, columns, strict=True)], axis=0)
    # What is less than two steps of the display, or than readings scatter by, is no lost step that anybody saw.
    ordinary = max(ORDINARY, 2.0 * step_um(values[told]), usual_size(rest[told]))
    range_um = float(np.ptp(shift))
    if name in _SUDDEN and range_um < ordinary:
        name = "zero_wanders"
    steel = f"; steel would have to be {warmer_k:z.0f} K warmer to stretch so" if stretch else ""
    words = _SAID[name].format(
        steps=moves,
        range=shown_number(range_um, 2),
        size=shown_number(sizes[0], sign="+"),
        more=shown_number(sizes[-1], sign="+"),
        where=where,
        fine=test.scale.fine,
        steel=steel,
    )
    if len(ways) > 1 and name in _SUDDEN and (name == "slip" or where == _BETWEEN):
        half = float(np.mean(np.abs(sizes))) / 2.0
        words += f". Up to {shown_number(half)} {test.scale.fine} of B and E may be this, too, if it goes on between the directions of a cycle"
    finding = Finding(
        f"{test.scale.kind}.{name}",
        "info" if name == "zero_wanders" else "warning",
        f"cycles differ: {words}",
        {f"size_{test.scale.figure}": float(sizes[0])},
    )
    return _MovingZero(finding, np.asarray(shift))


_SUDDEN = ("slip", "jump", "jumps")
_SAID = {
    "zero_wanders": "the zero wanders between runs by up to {range} {fine}, alike at all targets: ordinary air, heat and mounting of the instrument; "
    "R counts it as scatter. Where it has to be less: let instrument and machine settle, shield the beam",
    "slip": "the zero moves by {size} {fine} each cycle, alike at all targets: a coupling or an encoder that slips, or lost steps in "
    "every cycle; not warming, which would settle and stretch",
    "jump": "from {where} on all readings lie {size} {fine} off, alike at all targets: lost steps, or something that moved "
    "once; not backlash, which is the same in every cycle",
    "jumps": "from {where} all readings move by {steps} {fine}, alike at all targets, neither steadily nor settling: the zero "
    "of the instrument or of the axis wanders (air, mounting), or a coupling slips or steps are lost now and then; not "
    "backlash, which is the same in every cycle",
    "warming": "readings settle with a time constant of about {where} cycles, by {size} {fine} in the middle and {more} {fine} more from "
    "one end to the other: warming, or cooling",
    "settling": "readings settle with a time constant of about {where} cycles, by {size} {fine} in the middle and {more} {fine} more from "
    "one end to the other{steel}: no warming unless a thermometer says it, but a "
    "coupling or an encoder that slips less and less, or a part that yields",
}


def _jumps(within: Floats, moved: Floats, told: NDArray[np.bool_]) -> Iterator[list[float]]:
    """Yield the times of one jump, of two, up to one a cycle or ``_MOST_JUMPS``, that leave the least: found one by one, each looked for again.

    ``within``, ``moved``, ``told`` (ways, targets, cycles): time in cycles, readings about their mean over the cycles, and whether
    there is one.
    """
    times = np.sort(within.ravel())[1:]
    times = times[:: max(1, times.size // _MOST_TIMES)]
    products, along = _products_of_steps(times, within, moved, told)
    size = np.diag(products)
    # A jump lies between the reading before its time and the one at it.
    apart = 1.0 / (within.shape[0] * within.shape[1])
    first, after_last = float(within.min()), float(within.max()) + apart
    chosen: list[int] = []

    def held(others: list[int]) -> NDArray[np.bool_]:
        ends = np.concatenate([[first, after_last], times[others]])
        return np.asarray(np.abs(times[:, None] - ends).min(axis=1) > (_HELD - 0.5) * apart)

    def best(others: list[int]) -> int:
        shares, *_ = np.linalg.lstsq(products[np.ix_(others, others)], products[others], rcond=None)
        free = size - np.sum(products[others] * shares, axis=0)
        possible = (free > 1e-6 * np.maximum(size, 1.0)) & held(others)
        gain = np.where(possible, (along - along[others] @ shares) ** 2 / np.where(possible, free, 1.0), 0.0)
        return int(np.argmax(gain))

    while len(chosen) < min(within.shape[2], _MOST_JUMPS):
        chosen.append(best(chosen))
        for i in range(len(chosen)) if len(chosen) > 1 else ():
            chosen[i] = best(chosen[:i] + chosen[i + 1 :])
        yield [float(times[i]) for i in sorted(chosen)]


def _products_of_steps(times: Floats, within: Floats, moved: Floats, told: NDArray[np.bool_]) -> tuple[Floats, Floats]:
    """Return the products of the steps at times (n,), each about its mean over the cycles, with each other (n, n) and with readings (n,).

    No column of steps is made, which of a million readings would hold gigabytes: targets that all times part alike are one.
    """
    cycles = within.shape[2]
    rows = np.argsort(within[:, :, 0], axis=None, kind="stable")
    # By how many of the times readings are not earlier.
    behind = np.searchsorted(times, within.reshape(-1, cycles)[rows], side="right")
    begun = np.flatnonzero(np.append(True, np.any(np.diff(behind, axis=0) != 0, axis=1)))

    def from_time_on(values: Floats) -> tuple[Floats, Floats]:
        """Return sums of readings from each time on, and of all, for each group of targets."""
        grouped = np.add.reduceat(values.reshape(-1, cycles)[rows], begun, axis=0)
        sums = np.pad(np.cumsum(grouped[:, ::-1], axis=1)[:, ::-1], ((0, 0), (0, 1)))
        return np.take_along_axis(sums, first, axis=1), sums[:, :1]

    first = np.stack([np.searchsorted(group, np.arange(times.size), side="right") for group in behind[begun]])
    mean = 1.0 - first / cycles
    count, counts = from_time_on(told.astype(float))
    moves, all_moves = from_time_on(np.where(told, moved, 0.0))
    both = count.sum(axis=0)[np.maximum.outer(np.arange(times.size), np.arange(times.size))]
    crossed = count.T @ mean
    return both - crossed - crossed.T + mean.T @ (counts * mean), np.sum(moves - all_moves * mean, axis=0)


def _places(at: Sequence[float], within: Floats, test: LinearTest) -> str:
    """Return at which readings jumps are seen first."""
    told = []
    for time in at:
        way, target, cycle = (
            int(i) for i in np.argwhere(within >= time - 1e-9)[np.argmin(within[within >= time - 1e-9])]
        )
        told.append(f"cycle {test.cycle(cycle)} {test.ways[way]} at {test.position_mm[target]:g} {test.scale.unit}")
    return ", ".join(told)


def _wanders(rest_um: Floats) -> bool:
    """Return whether neighbours in time deviate alike, (ways, targets, cycles): what is left is no noise (von Neumann)."""
    in_time = np.concatenate([rest_um[0], *rest_um[1:, ::-1]])
    successive = float(np.nanmean(np.diff(in_time, axis=0) ** 2)) / 2.0
    return successive < min(0.7, 1.0 - 4.0 / np.sqrt(in_time.size)) * float(np.nanmean(in_time**2))
