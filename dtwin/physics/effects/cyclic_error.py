"""An error that repeats with the pitch of screw or scale."""

from __future__ import annotations

import numpy as np

from dtwin.physics.effect import Effect, Law, Parameter, Shape, ShapeParameter, moves, stacked
from dtwin.physics.state import State
from dtwin.schema import Floats


def columns(state: State, axis: str, shape: Shape) -> Floats:
    """Return cosine and sine of the position in a pitch, shape (n, 2)."""
    if not moves(state, axis):
        return np.zeros((state.n, 2))
    phase = 2.0 * np.pi * state.position_mm[axis] / shape["pitch_mm"]
    along = state.sensitivity[axis]
    return stacked(along * np.cos(phase), along * np.sin(phase))


EFFECT = Effect(
    name="cyclic_error",
    title="Cyclic error",
    group="drive",
    parameters=(Parameter("cosine", "um", 2.0), Parameter("sine", "um", 2.0)),
    regressors=columns,
    law=Law(0.0, None, "even"),
    meaning=("Eccentric screw or encoder, or interpolation error of the scale: repeats with each pitch of the axis."),
    formula="C cos(t) cos(2 pi x / p + f) for the X axis",
    looks_like="Fine lobes, densest where the axis is fastest; locked to position at every feed.",
    separate_by="Change the feed by 10 %: lobes locked to position stay, vibration moves.",
    remedy="Align screw and bearing, check the encoder coupling; a pitch table.",
    reference="ISO 230-4:2022 annex B, influence of typical machine errors on circular paths",
    shapes=(ShapeParameter("pitch_mm", "mm", 10.0, (), (0.5, 300.0)),),
    confusables=("cyclic_error_by_direction", "structural_resonance"),
    correctable="A pitch error table with steps well below the pitch.",
)
