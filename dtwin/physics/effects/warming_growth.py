"""Axes grow while the machine warms up, by a temperature that nobody logged."""

from __future__ import annotations

import numpy as np

from dtwin.physics.effect import SETTLING, Effect, Law, Parameter, Shape, moves, settled_h
from dtwin.physics.state import State
from dtwin.schema import Floats


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    if not moves(state, axis):
        return np.zeros((state.n, 1))
    grown = state.position_mm[axis] * state.sensitivity[axis]
    return (1e-3 * settled_h(state, shape) * grown)[:, None]


EFFECT = Effect(
    name="warming_growth",
    title="Growth with time",
    group="heat",
    parameters=(Parameter("growth", "um/(m h)", 30.0),),
    regressors=_columns,
    law=Law(0.0, 1.0, "even"),
    meaning="An axis grows with the time since the first run: the machine warms up, wherever the heat is.",
    formula="S (1 - exp(-h / S)) g R cos^2(t) for the X axis, h in hours since the first run",
    looks_like="The circle becomes oval with time, fast at first.",
    separate_by="Log the temperature of the scale or the screw and let the machine cool down in the middle of the test.",
    remedy="Warm up before measuring, cool the screw; scale with a temperature that follows it.",
    reference="ISO 230-3",
    kinds=("circular", "linear"),
    shapes=(SETTLING,),
    confusables=("thermal_growth", "thermal_drift", "scale_mismatch"),
    within_condition=True,
)
