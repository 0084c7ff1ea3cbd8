"""Two axes follow their commands with different delay."""

from __future__ import annotations

import numpy as np

from dtwin.physics.effect import Effect, Law, Parameter, Shape
from dtwin.physics.state import State
from dtwin.schema import Floats


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    if axis == state.plane:
        first, second = state.axes
        lag = state.velocity_mm_s[second] * state.sensitivity[second]
        lag = lag - state.velocity_mm_s[first] * state.sensitivity[first]
        return lag[:, None] * 0.5
    if axis not in state.axes:
        return np.zeros((state.n, 1))
    return (-state.velocity_mm_s[axis] * state.sensitivity[axis])[:, None]


EFFECT = Effect(
    name="servo_mismatch",
    title="Servo mismatch",
    group="dynamics",
    parameters=(Parameter("delay", "ms", 0.05),),
    regressors=_columns,
    law=Law(1.0, 0.0, "odd"),
    meaning=(
        "The position loops of two axes have different gains: one leads the other in time. "
        "One plane shows the difference of its two axes only."
    ),
    formula="d (F dtau / 2) sin(2t), tau in ms and F in mm/s",
    looks_like=("Oval along 45 or 135 degrees that turns over with the direction and grows with the feed."),
    separate_by="Reverse the direction; then double the feed: it must double.",
    remedy="Match the position loop gains, or enable feed forward on both axes.",
    reference="ISO 230-4:2022 annex B, influence of typical machine errors on circular paths",
    per="plane_or_axis",
    confusables=("squareness",),
    correctable="Lead each command by the delay of its axis; better in the servo than as an offset.",
)
