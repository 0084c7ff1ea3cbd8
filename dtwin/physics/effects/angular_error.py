"""An axis tilts along its travel, and the offset turns it into length."""

from __future__ import annotations

import numpy as np

from dtwin.physics.effect import Effect, Law, Parameter, Shape, moves
from dtwin.physics.state import State
from dtwin.schema import Floats


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    if not moves(state, axis):
        return np.zeros((state.n, 1))
    lever_mm = state.column("abbe_offset_mm")
    tilt = state.position_mm[axis] / 100.0
    return (1e-3 * lever_mm * tilt * state.sensitivity[axis])[:, None]


EFFECT = Effect(
    name="angular_error",
    title="Angular error (Abbe)",
    group="geometry",
    parameters=(Parameter("tilt_over_100_mm", "urad", 10.0),),
    regressors=_columns,
    law=Law(0.0, 1.0, "even"),
    meaning="Pitch or yaw of the axis acts over the distance between scale and tool.",
    formula="h e (x / 100 mm) cos(t) for the X axis",
    looks_like="Like a scale mismatch that changes with the height of the set-up.",
    separate_by="Measure at two heights and log abbe_offset_mm.",
    remedy="Check guideways; measure at the height of work.",
    reference="ISO 230-1",
    needs=("abbe_offset_mm",),
    confusables=("scale_mismatch", "straightness"),
    correctable="A compensation value of the control, or an offset of position.",
    within_condition=True,
)
