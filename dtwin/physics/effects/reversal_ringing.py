"""The structure rings after an axis reverses."""

from __future__ import annotations

import numpy as np

from dtwin.physics.effect import Effect, Law, Parameter, Shape, ShapeParameter, moves, stacked
from dtwin.physics.state import State
from dtwin.schema import Floats


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    if not moves(state, axis):
        return np.zeros((state.n, 2))
    t_s = state.since_reversal_s[axis]
    phase = 2.0 * np.pi * shape["frequency_hz"] * t_s
    swing = np.exp(-shape["damping_ratio"] * phase) * state.last_end[axis] * state.sensitivity[axis]
    swing = swing * state.feed_mm_s / 100.0
    return stacked(swing * np.cos(phase), swing * np.sin(phase))


EFFECT = Effect(
    name="reversal_ringing",
    title="Ringing after reversal",
    group="dynamics",
    parameters=(Parameter("cosine_at_100_mm_s", "um", 3.0), Parameter("sine_at_100_mm_s", "um", 3.0)),
    regressors=_columns,
    law=Law(None, None, "even"),
    meaning=("The jerk of the reversal excites a mode of the structure or of the servo, which dies out."),
    formula="F A exp(-2 pi d f t_r) cos(2 pi f t_r + p)",
    looks_like=("A decaying wave that begins at every reversal; its length in degrees grows with the feed."),
    separate_by=(
        "Change the feed: the wave keeps its period in time, a screw or gear error keeps its period in position."
    ),
    remedy="Lower jerk, damp or stiffen the structure, notch filter.",
    reference="[D] kinematics of a free damped oscillation",
    shapes=(
        ShapeParameter("frequency_hz", "Hz", 10.0, (4.0, 6.0, 9.0, 13.0, 18.0, 25.0, 35.0)),
        # What is damped more is no mode of a structure: a spike after a reversal looks like that.
        ShapeParameter("damping_ratio", "1", 0.05, (0.015, 0.05, 0.16)),
    ),
    confusables=("structural_resonance", "reversal_spike"),
    correctable="Input shaping; an offset at the rate of the path cannot.",
)
