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
# Beyond this an autoregression never forgets: it counts, it does not lag.
_MOST_MEMORY = 0.999
_LEAST_MEMORY = 0.05
_FEWEST_CYCLES = 12
_AS_GOOD = 1.15


@dataclass(frozen=True)
class ThermalModel:
    """One error motion from temperatures.

    ``per_k``, shape (sensors,): its unit per kelvin.
    ``memory``: share of the previous cycle that is kept, 0 for a static model.
    ``criterion``: what it was chosen by; smaller is better.
    ``tried``: number of inputs, memory and criterion of every candidate.
    """

    name: str
    sensors: tuple[str, ...]
    per_k: Floats
    memory: float
    criterion: float
    tried: tuple[tuple[int, bool, float], ...] = ()

    @property
    def free(self) -> int:
        """Number of fitted parameters."""
        return len(self.sensors) + (self.memory > 0.0)

    def run(self, rise_c: Floats) -> Floats:
        """Return the motion in free run: what it remembers is its own prediction.

        ``rise_c`` (cycles, sensors): temperatures of its sensors since the reference.
        Returns shape (cycles,).
        """
        driven = rise_c @ self.per_k
        if self.memory == 0.0:
            return np.asarray(driven)
        out = np.empty(len(driven))
        now = 0.0
        for i, pushed in enumerate(driven.tolist()):
            now = self.memory * now + pushed
            out[i] = now
        return out


def fit_thermal(
    name: str, motion: Floats, rise_c: Floats, sensors: Sequence[str], *, most: int = _MOST_INPUTS, static: bool = False
) -> ThermalModel:
    """Choose sensors one by one, with and without memory, by a criterion and by parsimony.

    Of the models whose residual is at most 15 % above that of the one with the best criterion, the
    one with the fewest parameters is kept.

    ``motion``, (cycles,): since the reference cycle.
    ``rise_c``, (cycles, sensors): temperatures since the reference cycle; a sensor with gaps is not offered.
    ``sensors``: names of the columns.
    ``most``: largest number of inputs to try.
    ``static``: try models without memory only.
    """
    if len(motion) < _FEWEST_CYCLES:
        raise InputError(
            "too few cycles for a thermal model",
            code="volumetric.cycles",
            got=str(len(motion)),
            allowed=f"at least {_FEWEST_CYCLES}",
        )
    tried: list[tuple[list[int], float, Floats, Floats | None]] = []
    for remembers in (False,) if static else (False, True):
        order, left = _order(motion, rise_c, min(most, rise_c.shape[1], len(motion) // 4), remembers=remembers)
        for count in range(1, len(order) + 1):
            chosen = order[:count]
            fitted = _remembering(motion, rise_c[:, chosen]) if remembers else (0.0, left[count - 1], None)
            tried.append((chosen, *fitted))
    leaves = np.array([left for _, _, left, _ in tried])
    power = np.einsum("ij,ij->i", leaves, leaves)
    # One number for all, or the criteria could not be compared.
    n = float(np.median(_independent(leaves)))
    free = [len(chosen) + (memory > 0.0) for chosen, memory, _, _ in tried]
    levels = (power / leaves.shape[1]).tolist()
    criteria = [_criterion(level, count, n) for level, count in zip(levels, free, strict=True)]
    liked = min(range(len(tried)), key=lambda i: criteria[i])
    # A sensor more must be worth its wire: the smallest model that leaves hardly more.
    good = np.flatnonzero(power <= _AS_GOOD**2 * power[liked]).tolist()
    best = min(good, key=lambda i: (free[i], criteria[i]))
    chosen, memory, _, per_k = tried[best]
    return ThermalModel(
        name,
        tuple(sensors[i] for i in chosen),
        _least_squares(rise_c[:, chosen], motion) if per_k is None else per_k,
        memory,
        criteria[best],
        tuple((len(one), kept > 0.0, said) for (one, kept, _, _), said in zip(tried, criteria, strict=True)),
    )


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


def _order(motion: Floats, rise_c: Floats, most: int, *, remembers: bool) -> tuple[list[int], list[Floats]]:
    """Return sensors in the order in which each leaves least together with those before it, and what each leaves."""
    left, rest = (motion[1:], rise_c[1:].copy()) if remembers else (motion, rise_c.copy())
    if remembers:
        past = motion[:-1] / max(float(np.linalg.norm(motion[:-1])), 1e-9)
        left, rest = left - past * (past @ left), rest - np.outer(past, past @ rest)
    chosen: list[int] = []
    leaves: list[Floats] = []
    for _ in range(most):
        size = np.einsum("ij,ij->j", rest, rest)
        gain = np.where(size > 1e-9, (left @ rest) ** 2 / np.maximum(size, 1e-9), -1.0)
        gain[chosen] = -1.0
        chosen.append(int(np.argmax(gain)))
        unit = rest[:, chosen[-1]] / max(float(np.sqrt(size[chosen[-1]])), 1e-9)
        left = left - unit * (unit @ left)
        rest -= unit[:, None] * (unit @ rest)
        leaves.append(left)
    return chosen, leaves


def _remembering(motion: Floats, used: Floats) -> tuple[float, Floats, Floats]:
    """Return memory, what is left in free run, and what a kelvin does; without memory where none is found."""
    memory, per_k = 0.0, _least_squares(used, motion)
    coefficients = _least_squares(np.column_stack([motion[:-1], used[1:]]), motion[1:])
    if _LEAST_MEMORY < coefficients[0] < _MOST_MEMORY:
        memory, per_k = float(coefficients[0]), coefficients[1:]
    return memory, motion - ThermalModel("", (), per_k, memory, float("nan")).run(used), per_k


def _least_squares(columns: Floats, values: Floats) -> Floats:
    return np.asarray(np.linalg.lstsq(columns, values, rcond=None)[0], dtype=np.float64)


def _criterion(level: float, free: int, n: float) -> float:
    """Return Schwarz's criterion with the small-sample correction, over n independent cycles; ``level``: mean square that is left."""
    if n <= free + 2:
        return math.inf
    return n * math.log(max(level, 1e-12)) + free * math.log(n) * n / (n - free - 2)
