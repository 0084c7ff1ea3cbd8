"""Lateral play that differs between the ends of an axis."""

from __future__ import annotations

import numpy as np

from dtwin.physics.effect import SECOND_AXIS, Effect, Law, Parameter, Shape, aside, moves
from dtwin.physics.state import State
from dtwin.schema import Floats


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    if not moves(state, axis):
        return np.zeros((state.n, 2))
    side = 0.5 * np.sign(state.velocity_mm_s[axis]) * state.position_mm[axis] / 100.0
    return aside(state, axis, side)


EFFECT = Effect(
    name="lateral_play_taper",
    title="Lateral play that changes along the axis",
    group="geometry",
    parameters=(
        Parameter("change_per_100_mm", "um", 2.0),
        Parameter("second_axis_change_per_100_mm", "um", 2.0, once="change_per_100_mm"),
    ),
    regressors=_columns,
    law=Law(0.0, 1.0, "odd"),
    meaning="Guideway play is larger at one end of the travel.",
    formula="d (dL / 2) (x / 100 mm) sgn(vx) sin(t) for the X axis" + SECOND_AXIS,
    looks_like=("Lobes that differ between the two ends of the axis and turn over with the direction."),
    separate_by="Measure the same circle at another place along the axis.",
    remedy="Inspect the guideway along its length.",
    reference="ISO 230-4:2022 annex B, influence of typical machine errors on circular paths",
    confusables=("lateral_play", "servo_mismatch"),
    correctable="A table of offsets by position and direction.",
)
