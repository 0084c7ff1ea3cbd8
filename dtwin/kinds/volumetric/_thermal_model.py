"""Error motions as sums of a few temperatures, chosen one by one, judged by whole campaigns.

Temperatures and motions are differences to a reference cycle. Errors of thermal series last for
hours, so that neighbouring cycles are not independent: the criterion counts as many cycles as the
autocorrelation of the residual leaves.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dtwin.errors import InputError
from dtwin.schema import Floats

_MOST_INPUTS = 10
_FEWEST_CYCLES = 12
_AS_GOOD = 1.15


@dataclass(frozen=True)
class ThermalModel:
    """One error motion from temperatures.

    ``per_k``, shape (sensors,): its unit per kelvin.
    """

    name: str
    sensors: tuple[str, ...]
    per_k: Floats

    def run(self, rise_c: Floats) -> Floats:
        """Return the motion (cycles,). ``rise_c`` (cycles, sensors): temperatures of its sensors since the reference."""
        return np.asarray(rise_c @ self.per_k)


def fit_thermal(
    name: str, motion: Floats, rise_c: Floats, sensors: Sequence[str], *, most: int = _MOST_INPUTS
) -> ThermalModel:
    """Choose sensors one by one, as many of them as :func:`best_of` says.

    ``motion``, (cycles,): since the reference cycle.
    ``rise_c``, (cycles, sensors): temperatures since the reference cycle; a sensor with gaps is not offered.
    ``sensors``: names of the columns.
    ``most``: largest number of inputs to try.
    """
    order, left = order_of(motion, rise_c, min(most, most_inputs(len(motion))))
    chosen = order[: 1 + best_of(left, range(1, len(order) + 1))]
    return ThermalModel(name, tuple(sensors[i] for i in chosen), least_squares(rise_c[:, chosen], motion))


def most_inputs(cycles: int) -> int:
    """Return how many inputs a model of so many cycles may have. Raises ``InputError`` with too few cycles."""
    if cycles < _FEWEST_CYCLES:
        raise InputError(
            "too few cycles for a thermal model",
            code="volumetric.cycles",
            got=str(cycles),
            allowed=f"at least {_FEWEST_CYCLES}",
        )
    return min(_MOST_INPUTS, cycles // 4)


def best_of(left: Sequence[Floats], free: Sequence[int]) -> int:
    """Return which model to keep: of those that leave at most 15 % more than the one with the best criterion the plainest.

    ``left``, (cycles,) each: what it leaves. ``free``: its number of parameters.
    """
    leaves = np.array(left)
    power = np.einsum("ij,ij->i", leaves, leaves)
    # One number for all, or the criteria could not be compared.
    n = float(np.median(_independent(leaves)))
    levels = (power / leaves.shape[1]).tolist()
    criteria = [_criterion(level, count, n) for level, count in zip(levels, free, strict=True)]
    liked = min(range(len(leaves)), key=lambda i: criteria[i])
    # A sensor more must be worth its wire: the smallest model that leaves hardly more.
    good = np.flatnonzero(power <= _AS_GOOD**2 * power[liked]).tolist()
    return int(min(good, key=lambda i: (free[i], criteria[i])))


def independent(values: Floats) -> float:
    """Return how many independent values a series stands for, by its lag-one correlation."""
    return float(_independent(values[None])[0])


def _independent(rows: Floats) -> Floats:
    n = rows.shape[1]
    centred = rows - rows.mean(axis=1, keepdims=True)
    power = np.einsum("ij,ij->i", centred, centred)
    along = np.einsum("ij,ij->i", centred[:, 1:], centred[:, :-1])
    lag = np.clip(np.divide(along, power, out=np.zeros_like(power), where=power > 0.0), 0.0, 0.98)
    return np.where(power > 0.0, np.maximum(4.0, n * (1.0 - lag) / (1.0 + lag)), n)


def inflation(rise_c: Floats) -> Floats:
    """Return the variance inflation of each input by the others, shape (sensors,).

    ``rise_c``, (cycles, sensors): inputs of one model.
    """
    centred = rise_c - rise_c.mean(axis=0)
    size = np.linalg.norm(centred, axis=0)
    correlation = (centred / size).T @ (centred / size)
    return np.asarray(np.diag(np.linalg.pinv(correlation)))


def order_of(motion: Floats, rise_c: Floats, most: int, beside: Floats | None = None) -> tuple[list[int], list[Floats]]:
    """Return sensors in the order in which each leaves least together with those before it, and what each leaves.

    ``most``: of them. ``beside``, (cycles,): what explains the motion before any sensor does.
    """
    left, rest = motion, rise_c.copy()
    if beside is not None:
        unit = beside / max(float(np.linalg.norm(beside)), 1e-9)
        left, rest = left - unit * (unit @ left), rest - np.outer(unit, unit @ rest)
    chosen: list[int] = []
    leaves: list[Floats] = []
    for _ in range(min(most, rise_c.shape[1])):
        size = np.einsum("ij,ij->j", rest, rest)
        gain = np.where(size > 1e-9, (left @ rest) ** 2 / np.maximum(size, 1e-9), -1.0)
        gain[chosen] = -1.0
        chosen.append(int(np.argmax(gain)))
        unit = rest[:, chosen[-1]] / max(float(np.sqrt(size[chosen[-1]])), 1e-9)
        left = left - unit * (unit @ left)
        rest -= unit[:, None] * (unit @ rest)
        leaves.append(left)
    return chosen, leaves


def least_squares(columns: Floats, values: Floats) -> Floats:
    """Return the weights of columns (n, k) that leave least of values (n,)."""
    return np.asarray(np.linalg.lstsq(columns, values, rcond=None)[0], dtype=np.float64)


def _criterion(level: float, free: int, n: float) -> float:
    """Return Schwarz's criterion with the small-sample correction, over n independent cycles; ``level``: mean square that is left."""
    if n <= free + 2:
        return math.inf
    return n * math.log(max(level, 1e-12)) + free * math.log(n) * n / (n - free - 2)
