"""An axis moves a constant share too far."""

from __future__ import annotations

import numpy as np

from dtwin.physics.effect import Effect, Law, Parameter, Shape, moves
from dtwin.physics.state import State
from dtwin.schema import Floats


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    if not moves(state, axis):
        return np.zeros((state.n, 1))
    return (1e-3 * state.position_mm[axis] * state.sensitivity[axis])[:, None]


EFFECT = Effect(
    name="lead_error",
    cause="scale",
    title="Lead error",
    group="geometry",
    # To a tone the scale is the gain of a probe or of a piezo, which may be off by some per cent.
    parameters=(Parameter("lead", "ppm", 20.0, most=50_000.0),),
    regressors=_columns,
    law=Law(None, None, "even"),
    meaning="The lead of screw or scale is off by a constant share.",
    formula="s x",
    looks_like="The error grows in proportion to the position.",
    separate_by="Measure cold and warm: growth by heat follows temperature.",
    remedy="Correct the scale factor of the axis, check the temperature of scale and screw.",
    reference="ISO 230-2",
    kinds=("linear", "sinusoidal"),
    confusables=("thermal_growth", "pitch_error"),
    correctable="A compensation value of the control, or an offset of position.",
)
