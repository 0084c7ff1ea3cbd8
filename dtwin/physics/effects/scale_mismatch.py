"""Two axes move different distances for the same command."""

from __future__ import annotations

import numpy as np

from dtwin.physics.effect import Effect, Law, Parameter, Shape
from dtwin.physics.state import State
from dtwin.schema import Floats


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    if axis == state.plane:
        first, second = state.axes
        gap = state.position_mm[first] * state.sensitivity[first]
        gap = gap - state.position_mm[second] * state.sensitivity[second]
        return gap[:, None] * 0.5e-3
    if axis not in state.axes:
        return np.zeros((state.n, 1))
    return (state.position_mm[axis] * state.sensitivity[axis])[:, None] * 1e-3


EFFECT = Effect(
    name="scale_mismatch",
    cause="scale",
    title="Scale mismatch",
    group="geometry",
    parameters=(Parameter("scale", "ppm", 20.0),),
    regressors=_columns,
    law=Law(0.0, 1.0, "even"),
    meaning=(
        "One axis moves further than the other for the same command: scale, screw lead or "
        "temperature of the axis. One plane shows the difference of its two axes only."
    ),
    formula="R (s1 - s2) / 2 * cos(2t), s in ppm",
    looks_like="Oval along 0 or 90 degrees, the same in both directions and at all feeds.",
    separate_by=(
        "Double the feed: effects of acceleration grow fourfold, a scale error stays. "
        "Measure when the machine is cold and warm to tell it from heat."
    ),
    remedy="Correct the scale factor of the axis, check the temperature of scale and screw.",
    reference="ISO 230-4:2022 annex B, influence of typical machine errors on circular paths",
    per="plane_or_axis",
    confusables=("inertial_compliance", "servo_lag", "thermal_growth", "angular_error"),
    correctable="A compensation value of the control, or an offset of position.",
)
