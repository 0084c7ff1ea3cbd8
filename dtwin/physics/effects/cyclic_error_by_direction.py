"""A cyclic error whose size or phase changes with the sense of travel."""

from __future__ import annotations

import numpy as np

from dtwin.physics.effect import Effect, Law, Parameter, Shape, ShapeParameter, moves, stacked, taken_up
from dtwin.physics.state import State
from dtwin.schema import Floats


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    if not moves(state, axis):
        return np.zeros((state.n, 2))
    phase = 2.0 * np.pi * state.position_mm[axis] / shape["pitch_mm"]
    # The screw changes from one flank to the other within some travel.
    side = np.sign(state.velocity_mm_s[axis]) * (2.0 * taken_up(state, axis, shape["standstill_um"]) - 1.0)
    along = state.sensitivity[axis] * side
    return stacked(along * np.cos(phase), along * np.sin(phase))


EFFECT = Effect(
    name="cyclic_error_by_direction",
    title="Cyclic error that depends on direction",
    group="drive",
    parameters=(Parameter("cosine", "um", 1.0), Parameter("sine", "um", 1.0)),
    regressors=_columns,
    law=Law(0.0, None, "odd"),
    meaning=("The cyclic error differs between forward and reverse travel: play inside the screw drive."),
    formula="sgn(v) C cos(t) cos(2 pi x / p + f) for the X axis, once the other flank bears",
    looks_like="Fine lobes whose size or phase changes with the direction.",
    separate_by="Run slowly in both directions along a straight line with a laser interferometer.",
    remedy="As for the cyclic error; the table must be by direction.",
    reference="ISO 230-4:2022 annex B, influence of typical machine errors on circular paths",
    shapes=(
        ShapeParameter("pitch_mm", "mm", 10.0, (), (0.5, 300.0)),
        ShapeParameter("standstill_um", "um", 10.0, (), (0.0, 200.0)),
    ),
    confusables=("cyclic_error",),
    correctable="Pitch tables for each direction.",
)
