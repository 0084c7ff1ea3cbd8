"""Thermal models that remember the cycle before, as an autoregression does: a correction in service does not know it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dtwin.kinds.volumetric._thermal_model import ThermalModel, best_of, least_squares, most_inputs, order_of
from dtwin.schema import Floats

# Beyond this an autoregression never forgets: it counts, it does not lag.
_MOST_MEMORY = 0.999
_LEAST_MEMORY = 0.05


@dataclass(frozen=True)
class RememberingModel(ThermalModel):
    """A thermal model. ``memory``: share of the previous cycle that is kept, 0 for a static one."""

    memory: float = 0.0

    def run(self, rise_c: Floats) -> Floats:
        """Return the motion (cycles,) in free run: what it remembers is its own prediction. ``rise_c``: as of ``ThermalModel``."""
        driven = super().run(rise_c)
        now = 0.0
        for i, pushed in enumerate(driven.tolist()):
            driven[i] = now = self.memory * now + pushed
        return driven


def fit_remembering(name: str, motion: Floats, rise_c: Floats, sensors: Sequence[str]) -> RememberingModel:
    """Choose sensors one by one, with and without memory; arguments as of :func:`fit_thermal`."""
    most = most_inputs(len(motion))
    order, left = order_of(motion, rise_c, most)
    tried: list[RememberingModel] = []
    for count in range(1, len(order) + 1):
        chosen = order[:count]
        names = tuple(sensors[i] for i in chosen)
        tried.append(RememberingModel(name, names, least_squares(rise_c[:, chosen], motion)))
    order = order_of(motion[1:], rise_c[1:], most, motion[:-1])[0]
    for count in range(1, len(order) + 1):
        chosen = order[:count]
        tried.append(_remembering(name, tuple(sensors[i] for i in chosen), motion, rise_c[:, chosen]))
        left.append(motion - tried[-1].run(rise_c[:, chosen]))
    return tried[best_of(left, [len(model.sensors) + (model.memory > 0.0) for model in tried])]


def _remembering(name: str, sensors: tuple[str, ...], motion: Floats, used: Floats) -> RememberingModel:
    """Return a model with its memory; a static one where none is found."""
    coefficients = least_squares(np.column_stack([motion[:-1], used[1:]]), motion[1:])
    if _LEAST_MEMORY < coefficients[0] < _MOST_MEMORY:
        return RememberingModel(name, sensors, coefficients[1:], float(coefficients[0]))
    return RememberingModel(name, sensors, least_squares(used, motion))
