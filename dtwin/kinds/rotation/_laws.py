"""What values at several speeds follow: nothing, the speed, its square, a resonance, or the time; judged on speeds held out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dtwin.schema import Floats
from dtwin.statistics import f_tail

CONSTANT, SPEED, SQUARE, TIME, RESONANCE = "constant", "speed", "square", "time", "resonance"
FEWEST_SPEEDS = 4
_FEWEST_RESONANCE = 6
_WIDE = 1.5
"""Times the lowest speed that the highest must be: between nearer ones nothing grows enough to be seen, or not seen."""
_BETTER = 0.5
"""A law must leave no more of the squares on speeds held out than this part of what the simpler one leaves."""
_AS_GOOD = 1.5
"""A rival that leaves no more than this many times as much is not told apart."""
_TOGETHER = 0.9
"""Time and speed that are correlated more are not told apart, whatever is left: no drift is quite straight."""
_CHANCE = 0.01
_SAME_SPEED = 0.01
_DAMPING = (0.01, 0.02, 0.05, 0.1, 0.2)
_REACHED = 2.0
"""Times the highest speed up to which a critical speed is told: what lies farther off bends a square only a little."""
_CRITICAL = np.geomspace(0.25, 4.0, 385)


@dataclass(frozen=True)
class Law:
    """What values follow.

    ``name``: ``constant``, ``speed``, ``square``, ``time``, ``resonance``, or ``speed+time``, ``square+time``; empty when several would do.
    ``rivals``: those that cannot be told apart, the best first; one when it is named.
    ``change``: largest distance of two fitted values, of the best law.
    ``left``: RMS on speeds held out, by law.
    ``p_value``: of the best law against the constant.
    ``speeds``: distinct ones.
    ``critical_rpm``: of a resonance; NaN without.
    ``bent``: whether a resonance fits far better than the square of the speed does, though it predicts no better.
    """

    name: str
    rivals: tuple[str, ...]
    change: float
    left: Mapping[str, float]
    p_value: float
    speeds: int
    critical_rpm: float = float("nan")
    bent: bool = False


def groups_of(speed_rpm: Floats) -> Floats:
    """Return the number of the group of each speed; those within 1 % are one."""
    order = np.argsort(speed_rpm)
    ranked = speed_rpm[order]
    new = np.concatenate([[False], np.diff(ranked) > _SAME_SPEED * np.maximum(ranked[1:], 1e-9)])
    out = np.empty(len(speed_rpm))
    out[order] = np.cumsum(new)
    return out


def law_of(values: Floats, speed_rpm: Floats, time: Floats, noise: float, *, pairs: bool = False) -> Law | None:
    """Return what values (n, parts) follow; None with fewer than four distinct speeds, or near ones.

    ``noise``: variance of one part of a value, by its repeats within a run; what is left is taken to be no less.
    ``pairs``: whether speed and time together are tried, beside the best of them alone.
    """
    group = groups_of(speed_rpm)
    count = len(np.unique(group))
    if count < FEWEST_SPEEDS or speed_rpm.max() < _WIDE * speed_rpm.min():
        return None
    n = speed_rpm / speed_rpm.max()
    ones = np.ones(len(n))
    designs = {CONSTANT: ones[:, None], SPEED: np.column_stack([ones, n]), SQUARE: np.column_stack([ones, n**2])}
    if np.ptp(time) > 0.0:
        designs[TIME] = np.column_stack([ones, (time - time.mean()) / np.ptp(time)])
    held = {name: _held_out(design, values, group) for name, design in designs.items()}
    critical, bent = float("nan"), False
    if values.shape[1] == 2 and count >= _FEWEST_RESONANCE:
        held[RESONANCE] = _held_out_resonance(values, n, group)
    others = [name for name in held if name != CONSTANT]
    chance = {}
    for name in others:
        if name == RESONANCE:
            fitted, shape = _resonance(values, n, ones.astype(bool))
            critical = shape * float(speed_rpm.max())
            chance[name] = _chance(values, fitted, held_dof=6, noise=noise)
            # As if what the square of the speed leaves were to be explained.
            square = designs[SQUARE] @ np.linalg.lstsq(designs[SQUARE], values, rcond=None)[0]
            bent = _chance(values - square, fitted - square, held_dof=6, noise=noise) < _CHANCE
        else:
            fitted = designs[name] @ np.linalg.lstsq(designs[name], values, rcond=None)[0]
            chance[name] = _chance(values, fitted, held_dof=2 * values.shape[1], noise=noise)
    able = [
        name
        for name in sorted(others, key=lambda name: held[name])
        if chance[name] < _CHANCE / len(others) and held[name] < _BETTER * held[CONSTANT]
    ]
    if RESONANCE in able and critical > _REACHED * float(speed_rpm.max()):
        able.remove(RESONANCE)
    left = {name: float(np.sqrt(sse / values.size)) for name, sse in held.items()}
    if pairs and TIME in designs:
        both = _pair(values, designs, group, held, noise)
        if both is not None and (not able or _beside(values, designs, able[0], both[0][0], noise)):
            names, change, p_value = both
            return Law(names[0] if len(names) == 1 else "", names, change, left, p_value, count)
    if not able:
        return Law(CONSTANT, (CONSTANT,), 0.0, left, min(chance.values()), count, bent=bent)
    able.sort(key=lambda name: held[name])
    # A resonance has three numbers more: it must earn them.
    if able[0] == RESONANCE and len(able) > 1 and held[RESONANCE] > _BETTER * held[able[1]]:
        able = [*able[1:], RESONANCE]
    best = able[0]
    rivals = (
        best,
        *(
            name
            for name in able[1:]
            if name != RESONANCE and (held[name] < _AS_GOOD * held[best] or _together(best, name, designs))
        ),
    )
    fitted = (
        _resonance(values, n, ones.astype(bool))[0]
        if best == RESONANCE
        else designs[best] @ np.linalg.lstsq(designs[best], values, rcond=None)[0]
    )
    change = float(max(np.linalg.norm(a - b) for a in fitted for b in fitted))
    name = best if len(rivals) == 1 else ""
    return Law(name, rivals, change, left, chance[best], count, critical if best == RESONANCE else float("nan"), bent)


def _pair(
    values: Floats, designs: Mapping[str, Floats], group: Floats, held: Mapping[str, float], noise: float
) -> tuple[tuple[str, ...], float, float] | None:
    """Return which of speed or its square with the time values follow, the largest change, and how probable it is by chance; else None."""
    laws: dict[str, tuple[float, float, float]] = {}
    for name in (SPEED, SQUARE):
        if _together(TIME, name, designs):
            continue
        design = np.column_stack([designs[name], designs[TIME][:, 1]])
        fitted = design @ np.linalg.lstsq(design, values, rcond=None)[0]
        chance = _chance(values, fitted, held_dof=3 * values.shape[1], noise=noise)
        sse = _held_out(design, values, group)
        if chance < _CHANCE / 2.0 and sse < _BETTER * min(held[n] for n in (CONSTANT, SPEED, SQUARE, TIME)):
            laws[f"{name}+{TIME}"] = (sse, float(np.ptp(fitted)), chance)
    if not laws:
        return None
    best = min(laws, key=lambda name: laws[name][0])
    names = sorted((n for n in laws if laws[n][0] < _AS_GOOD * laws[best][0]), key=lambda n: laws[n][0])
    return tuple(names), *laws[best][1:]


def _beside(values: Floats, designs: Mapping[str, Floats], one: str, both: str, noise: float) -> bool:
    """Return whether a law of two takes what one of them leaves by no chance."""
    pair = np.column_stack([designs[both.partition("+")[0]], designs[TIME][:, 1]])
    alone, fitted = (d @ np.linalg.lstsq(d, values, rcond=None)[0] for d in (designs[one], pair))
    return _chance(values - alone, fitted - alone, held_dof=3 * values.shape[1], noise=noise) < _CHANCE / 2.0


def _together(one: str, other: str, designs: Mapping[str, Floats]) -> bool:
    """Return whether one of two laws is of the time, and rose with the other."""
    if TIME not in (one, other) or RESONANCE in (one, other):
        return False
    return abs(float(np.corrcoef(designs[one][:, 1], designs[other][:, 1])[0, 1])) > _TOGETHER


def _held_out(design: Floats, values: Floats, group: Floats) -> float:
    """Return the squares left on each speed by the others."""
    total = 0.0
    for g in np.unique(group):
        own = group == g
        coefficients = np.linalg.lstsq(design[~own], values[~own], rcond=None)[0]
        total += float(np.sum((values[own] - design[own] @ coefficients) ** 2))
    return total


def _held_out_resonance(values: Floats, n: Floats, group: Floats) -> float:
    total = 0.0
    for g in np.unique(group):
        own = group == g
        fitted, _ = _resonance(values, n, ~own)
        total += float(np.sum((values[own] - fitted[own]) ** 2))
    return total


def _resonance(values: Floats, n: Floats, use: NDArray[np.bool_]) -> tuple[Floats, float]:
    """Return values fitted by a constant and a rotor with one critical speed, and that speed (of the largest one).

    Values are the angles of the high spot on a rotor that turns forward: it comes the later, the nearer the resonance.
    """
    v = values[:, 0] + 1j * values[:, 1]
    critical, damping = (grid.ravel() for grid in np.meshgrid(_CRITICAL, _DAMPING))
    r = n / critical[:, None]
    shape = r**2 / (1.0 - r**2 - 2j * damping[:, None] * r)
    # A straight line through complex numbers, for all shapes at once.
    off = shape[:, use] - shape[:, use].mean(axis=1, keepdims=True)
    moved = v[use] - v[use].mean()
    gain = (np.conj(off) @ moved) / np.sum(np.abs(off) ** 2, axis=1)
    best = int(np.argmin(np.sum(np.abs(moved - gain[:, None] * off) ** 2, axis=1)))
    fitted = v[use].mean() + gain[best] * (shape[best] - shape[best, use].mean())
    return np.column_stack([fitted.real, fitted.imag]), float(critical[best])


def _chance(values: Floats, fitted: Floats, held_dof: int, noise: float) -> float:
    """Return how probable it is that chance takes as much of the squares as a law does."""
    parts = values.shape[1]
    whole = float(np.sum((values - values.mean(axis=0)) ** 2))
    left = float(np.sum((values - fitted) ** 2))
    more, rest = held_dof - parts, values.size - held_dof
    if rest < 1 or whole <= 0.0:
        return 1.0
    spread = max(left / rest, noise, 1e-300)
    return f_tail((whole - left) / more / spread, (float(more), float(rest)))
