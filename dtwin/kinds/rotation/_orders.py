"""What turns at another rate than the axis: orders that are no whole numbers, in what differs from turn to turn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from dtwin.kinds.rotation._turns import Turns
from dtwin.schema import Floats
from dtwin.units import shown_number

_FEWEST_TURNS = 8
_FALSE = 1e-3
_BESIDE = 2.0
_NEIGHBOURS = 12
_MOST = 5
_FAR_ABOVE = 3.0
"""Times what is the same in every turn."""
_SLOW = 0.5
_LEAST = 2e-4
"""Part of a turn's range that the grid of angles may leave of a wave."""
_KNOWN = 4.0
"""Of so many neighbours one counts: their median is scattered, and a window makes neighbours alike."""
_LN2 = float(np.log(2.0))


@dataclass(frozen=True)
class Order:
    """A line of the spectrum: times a turn, amplitude, and how sure it is no chance."""

    order: float
    amplitude_um: float
    p_value: float
    resolution: float


def orders_of(turns: Turns) -> tuple[Order, ...]:
    """Return the lines between the whole orders, the largest first; none of fewer than eight turns in a row.

    A line stands out of the median of its neighbours by so much that among all of them chance does so once in a thousand runs.
    """
    if turns.n < _FEWEST_TURNS or turns.n != turns.whole:
        return ()
    left = (turns.moved_um - turns.moved_um.mean(axis=0)).ravel()
    # Backwards the rows are in the order of time, and each row is not.
    series = left if turns.forward else turns.moved_um[::-1].ravel() - np.tile(turns.moved_um.mean(axis=0), turns.n)
    n = len(series)
    window = np.hanning(n)
    power = np.abs(np.fft.rfft(series * window)) ** 2
    power[0] = 0.0
    order = np.arange(len(power)) / turns.n
    near = np.abs(order - np.round(order)) * turns.n
    usable = (near > _BESIDE) & (order * turns.n > _BESIDE)
    usable[-1] = False
    floor, known = _floor(power, usable)
    least = _LEAST * float(np.ptp(turns.read_um, axis=1).mean())
    ratio = np.divide(power, floor, out=np.zeros(len(power)), where=floor > 0.0)
    tests = int(usable.sum())
    orders: list[Order] = []
    for k in np.argsort(-ratio):
        if not usable[k] or len(orders) == _MOST:
            break
        single = float((1.0 + ratio[k] / known) ** -known)
        chance = float(-np.expm1(tests * np.log1p(-min(single, 0.5))))
        if chance > _FALSE:
            break
        if power[k] < max(power[k - 1], power[k + 1]):
            continue
        shift = _vertex(*np.sqrt(power[k - 1 : k + 2]))
        at = (k + shift) / turns.n
        if any(abs(at - other.order) * turns.n < 2.0 * _BESIDE for other in orders):
            continue
        amplitude = 2.0 * float(np.sqrt(power[k])) / float(window.sum())
        if amplitude > least:
            orders.append(Order(float(at), amplitude, chance, 1.0 / turns.n))
    return tuple(sorted(orders, key=lambda line: -line.amplitude_um))


def _floor(power: Floats, usable: NDArray[np.bool_]) -> tuple[Floats, float]:
    """Return the mean power about each bin, by the median of its nearest neighbours on both sides, and for how many it stands.

    What differs from turn to turn in one order stands out of all of the spectrum, and not of its neighbours.
    """
    at = np.flatnonzero(usable)
    floor = np.full(len(power), np.inf)
    reach = _NEIGHBOURS + 2
    if len(at) > 2 * reach:
        # A line is wider than a bin: the nearest two on both sides are its own.
        windows = sliding_window_view(np.pad(power[at], reach, mode="reflect"), 2 * reach + 1)
        beside = np.delete(windows, np.arange(_NEIGHBOURS, _NEIGHBOURS + 5), axis=1)
        floor[at] = np.median(beside, axis=1) / _LN2
    return floor, 2.0 * _NEIGHBOURS / _KNOWN


def _vertex(before: float, at: float, after: float) -> float:
    """Return where a parabola through three neighbours is highest, in bins."""
    bend = before - 2.0 * at + after
    return float(np.clip(0.5 * (before - after) / bend, -0.5, 0.5)) if bend else 0.0


def pulses_a_turn(lines: Sequence[Order], turns: Turns) -> int:
    """Return how many pulses a turn has, where all but the smallest part of what is read comes again after several; else 1.

    The axis's own once per turn is the largest line then, at one over that number.
    """
    if not lines or not 0.0 < lines[0].order <= _SLOW + lines[0].resolution / 2.0:
        return 1
    times = round(1.0 / lines[0].order)
    exact = abs(lines[0].order - 1.0 / times) < lines[0].resolution / 4.0
    mean_turn = 0.5 * float(np.ptp(turns.moved_um.mean(axis=0)))
    return times if exact and lines[0].amplitude_um > _FAR_ABOVE * mean_turn else 1


def order_of_a_turn(lines: Sequence[Order], turns: Turns) -> float:
    """Return the order at which a turn comes, where all but the smallest part of what is read is whole multiples of it; else 1.

    As of a speed that was stated wrongly: what repeats with the true turns then repeats with no turn.
    """
    mean_turn = 0.5 * float(np.ptp(turns.moved_um.mean(axis=0)))
    large = [line for line in lines if line.amplitude_um > _FAR_ABOVE * mean_turn]
    first = min(large, key=lambda line: line.order, default=None)
    if first is None:
        return 1.0
    times = [line.order / first.order for line in lines if line.order > 1.5 * first.order]
    whole = all(abs(n - round(n)) < n * first.resolution / (2.0 * first.order) for n in times)
    return first.order if times and whole else 1.0


def said_orders(lines: Sequence[Order]) -> str:
    """Return lines in words, with what can turn so."""
    told = []
    for slow, cause in (
        (True, "slower than half a turn, as the cage of a rolling bearing or a belt is"),
        (
            False,
            "no whole number, so not of the axis itself: rolling elements, a belt, a motor or its gear, or vibration",
        ),
    ):
        own = [line for line in lines if (line.order < _SLOW) == slow]
        if own:
            named = ", ".join(
                f"order {o.order:z.2f} ± {o.resolution / 2:z.2f} ({shown_number(o.amplitude_um)} µm)" for o in own
            )
            told.append(f"{named}: {cause}")
    return "; ".join(told)
