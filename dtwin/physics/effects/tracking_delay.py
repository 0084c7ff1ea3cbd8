"""The tool follows its command late by a constant time."""

from __future__ import annotations

import numpy as np

from dtwin.physics.effect import Effect, Law, Parameter, Shape, moves
from dtwin.physics.state import State
from dtwin.schema import Floats


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    if not moves(state, axis):
        return np.zeros((state.n, 1))
    return (-state.velocity_mm_s[axis] * state.sensitivity[axis])[:, None]


EFFECT = Effect(
    name="tracking_delay",
    title="Tracking delay",
    group="dynamics",
    parameters=(Parameter("delay", "ms", 0.1, most=500.0),),
    regressors=_columns,
    law=Law(1.0, 0.0, "even"),
    meaning="Dead time or velocity lag: the tool is where the command was a moment ago.",
    formula="-v tau, v in mm/s and tau in ms",
    looks_like="A quarter of a period behind the command, in proportion to frequency and amplitude.",
    separate_by="Double the frequency: the error doubles; what a mode adds grows with its square.",
    remedy="Velocity feed forward, or lead the command by the delay.",
    reference="[D] first-order expansion of a delayed command",
    kinds=("sinusoidal",),
    confusables=("servo_response", "guideway_friction"),
    correctable="Lead the command by the delay.",
)
