"""An axis lags behind its command by a constant amount, on the side it comes from."""

from __future__ import annotations

import numpy as np

from dtwin.physics.effect import Effect, Law, Parameter, Shape, ShapeParameter, moves, taken_up
from dtwin.physics.state import State
from dtwin.schema import Floats


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    if not moves(state, axis):
        return np.zeros((state.n, 1))
    # The table stands still until the drive has taken up the play.
    step = -np.sign(state.velocity_mm_s[axis]) * (taken_up(state, axis, shape["standstill_um"]) - 0.5)
    return (step * state.sensitivity[axis])[:, None]


EFFECT = Effect(
    name="backlash",
    cause="backlash",
    title="Backlash",
    group="drive",
    parameters=(Parameter("backlash", "um", 5.0),),
    regressors=_columns,
    law=Law(0.0, 0.0, "odd"),
    meaning="Lost motion in the drive: play in nut, coupling or gear, or wind-up of the screw. Below zero: the compensation in the control is too large.",
    formula="-(B / 2) sgn(v) cos(t) for the X axis, once the play is taken up",
    shapes=(ShapeParameter("standstill_um", "um", 3.0, (0.1, 4.0, 12.0), (0.0, 300.0), as_large=True),),
    # The table stands still for as long as its play is wide.
    also_tried=tuple({"standstill_um": um} for um in (25.0, 40.0, 75.0, 120.0, 190.0, 300.0)),
    also_tried_on=("circular", "sinusoidal"),
    looks_like="Steps where the axis reverses, in or out; the same at all feeds.",
    separate_by="Lower the feed: spikes shrink, a step stays.",
    remedy="Preload or renew nut and bearings; else enter backlash compensation in the control.",
    reference="ISO 230-4:2022 annex B, influence of typical machine errors on circular paths",
    kinds=("circular", "linear", "sinusoidal"),
    confusables=("friction", "reversal_spike", "lateral_play"),
    correctable=("Backlash compensation of the control, or an offset that jumps with the direction of the axis."),
)
