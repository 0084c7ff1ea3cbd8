"""A soft mode bends with the acceleration and rings after reversals."""

from __future__ import annotations

import numpy as np

from dtwin.physics.effect import Effect, Law, Parameter, Shape, ShapeParameter, moves, stacked
from dtwin.physics.state import State
from dtwin.schema import Floats


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    if not moves(state, axis):
        return np.zeros((state.n, 3))
    t_s = state.since_reversal_s[axis]
    phase = 2.0 * np.pi * shape["frequency_hz"] * t_s
    swing = np.exp(-shape["damping_ratio"] * phase) * state.last_end[axis] * state.sensitivity[axis]
    swing = swing * state.feed_mm_s / 100.0
    bend = -1e-3 * state.acceleration_mm_s2[axis] * state.sensitivity[axis]
    return stacked(bend, swing * np.cos(phase), swing * np.sin(phase))


EFFECT = Effect(
    name="structural_resonance",
    title="Structural resonance",
    group="dynamics",
    parameters=(
        Parameter("compliance", "um/(m/s2)", 5.0, positive=True),
        Parameter("cosine_at_100_mm_s", "um", 2.0),
        Parameter("sine_at_100_mm_s", "um", 2.0),
    ),
    regressors=_columns,
    law=Law(None, None, "even"),
    meaning=(
        "A mode of low stiffness between drive and tool: it deflects with the acceleration "
        "of the path and rings when an axis reverses."
    ),
    formula="c F^2/R cos^2(t) + F A exp(-2 pi d f t_r) cos(2 pi f t_r + p)",
    looks_like=("An oval that grows with the square of the feed, with a decaying wave after reversals."),
    separate_by=("Change the feed by 10 %: the wave keeps its period in time. Accelerometers name the frequency."),
    remedy="Stiffen or damp the mode, lower jerk and acceleration.",
    reference="[D] second-order mode driven by the acceleration of the path",
    shapes=(
        ShapeParameter("frequency_hz", "Hz", 10.0, (4.0, 6.0, 9.0, 13.0, 18.0, 25.0, 35.0)),
        # What is damped more is no mode of a structure: a spike after a reversal looks like that.
        ShapeParameter("damping_ratio", "1", 0.05, (0.015, 0.05, 0.16)),
    ),
    confusables=("inertial_compliance", "reversal_ringing", "servo_lag"),
    at_one_speed="reversal_ringing",
    correctable=("The part that follows the acceleration; the ringing cannot be corrected by offsets."),
)
