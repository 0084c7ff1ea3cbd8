"""Error motions as sums of a few temperatures, chosen one by one, judged by whole campaigns.

Temperatures and motions are differences to a reference cycle. Errors of thermal series last for
hours, so that neighbouring cycles are not independent: the criterion counts as many cycles as the
autocorrelation of the residual leaves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

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
    fits: list[tuple[ThermalModel, Floats]] = []
    for remembers in (False,) if static else (False, True):
        order = _order(motion, rise_c, min(most, rise_c.shape[1], len(motion) // 4), remembers=remembers)
        for count in range(1, len(order) + 1):
            fits.append(_fitted(name, motion, rise_c, order[:count], sensors, remembers=remembers))
    # One number for all, or the criteria could not be compared.
    n = float(np.median([independent(left) for _, left in fits]))
    models = [replace(model, criterion=_criterion(left, model.free, n)) for model, left in fits]
    liked = min(range(len(models)), key=lambda i: models[i].criterion)
    enough = _AS_GOOD * float(np.linalg.norm(fits[liked][1]))
    # A sensor more must be worth its wire: the smallest model that leaves hardly more.
    good = [m for m, (_, left) in zip(models, fits, strict=True) if np.linalg.norm(left) <= enough]
    best = min(good, key=lambda m: (m.free, m.criterion))
    return replace(best, tried=tuple((len(m.sensors), m.memory > 0.0, m.criterion) for m in models))


def independent(values: Floats) -> float:
    """Return how many independent values a series stands for, by its lag-one correlation."""
    centred = values - values.mean()
    power = float(centred @ centred)
    if power <= 0.0:
        return float(len(values))
    lag = min(max(float(centred[1:] @ centred[:-1]) / power, 0.0), 0.98)
    return max(4.0, len(values) * (1.0 - lag) / (1.0 + lag))


def inflation(rise_c: Floats) -> Floats:
    """Return the variance inflation of each input by the others, shape (sensors,).

    ``rise_c``, (cycles, sensors): inputs of one model.
    """
    centred = rise_c - rise_c.mean(axis=0)
    size = np.linalg.norm(centred, axis=0)
    correlation = (centred / size).T @ (centred / size)
    return np.asarray(np.diag(np.linalg.pinv(correlation)))


def _order(motion: Floats, rise_c: Floats, most: int, *, remembers: bool) -> list[int]:
    """Return sensors in the order in which each leaves least together with those before it."""
    left, rest = (motion[1:], rise_c[1:].copy()) if remembers else (motion, rise_c.copy())
    if remembers:
        past = motion[:-1] / max(float(np.linalg.norm(motion[:-1])), 1e-9)
        left, rest = left - past * (past @ left), rest - np.outer(past, past @ rest)
    chosen: list[int] = []
    for _ in range(most):
        size = (rest**2).sum(axis=0)
        gain = np.where(size > 1e-9, (left @ rest) ** 2 / np.maximum(size, 1e-9), -1.0)
        gain[chosen] = -1.0
        chosen.append(int(np.argmax(gain)))
        unit = rest[:, chosen[-1]] / max(float(np.sqrt(size[chosen[-1]])), 1e-9)
        left, rest = left - unit * (unit @ left), rest - np.outer(unit, unit @ rest)
    return chosen


def _fitted(
    name: str, motion: Floats, rise_c: Floats, chosen: Sequence[int], sensors: Sequence[str], *, remembers: bool
) -> tuple[ThermalModel, Floats]:
    used = rise_c[:, list(chosen)]
    memory = 0.0
    per_k: Floats = np.asarray(np.linalg.lstsq(used, motion, rcond=None)[0], dtype=np.float64)
    if remembers:
        design = np.column_stack([motion[:-1], used[1:]])
        coefficients = np.linalg.lstsq(design, motion[1:], rcond=None)[0]
        if _LEAST_MEMORY < coefficients[0] < _MOST_MEMORY:
            memory, per_k = float(coefficients[0]), np.asarray(coefficients[1:], dtype=np.float64)
    model = ThermalModel(name, tuple(sensors[i] for i in chosen), per_k, memory, float("nan"))
    return model, motion - model.run(used)


def _criterion(left: Floats, free: int, n: float) -> float:
    """Return Schwarz's criterion with the small-sample correction, over n independent cycles."""
    if n <= free + 2:
        return float("inf")
    level = max(float((left**2).mean()), 1e-12)
    return float(n * np.log(level) + free * np.log(n) * n / (n - free - 2))
