"""Backlash that differs between the ends of an axis."""

from __future__ import annotations

import numpy as np

from dtwin.physics.effect import Effect, Law, Parameter, Shape, ShapeParameter, moves, taken_up
from dtwin.physics.state import State
from dtwin.schema import Floats


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    if not moves(state, axis):
        return np.zeros((state.n, 1))
    side = np.sign(state.velocity_mm_s[axis]) * (taken_up(state, axis, shape["standstill_um"]) - 0.5)
    step = -side * state.position_mm[axis] / 100.0
    return (step * state.sensitivity[axis])[:, None]


EFFECT = Effect(
    name="backlash_taper",
    cause="backlash_taper",
    title="Backlash that changes along the axis",
    group="drive",
    parameters=(Parameter("change_per_100_mm", "um", 2.0),),
    regressors=_columns,
    law=Law(0.0, 1.0, "odd"),
    meaning=(
        "Backlash is larger at one end of the travel: a worn stretch of the screw, or wind- "
        "up that depends on the free length."
    ),
    formula="-(dB / 2) (x / 100 mm) sgn(v) cos(t) for the X axis, once the play is taken up",
    shapes=(ShapeParameter("standstill_um", "um", 10.0, (1.0, 10.0, 60.0), (0.0, 200.0)),),
    looks_like="Steps of different size at the two ends of the axis.",
    separate_by="Measure the same circle at another place along the axis.",
    remedy=("Inspect the screw along its length; a table of backlash by position if the control has one."),
    reference="ISO 230-4:2022 annex B, influence of typical machine errors on circular paths",
    kinds=("circular", "linear"),
    confusables=("backlash", "lateral_play"),
    correctable="A table of backlash by position.",
)
