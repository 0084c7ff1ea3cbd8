"""The axis sticks for a moment when it reverses."""

from __future__ import annotations

import numpy as np

from dtwin.physics.effect import Effect, Law, Parameter, Shape, ShapeParameter, moves, stacked
from dtwin.physics.state import State
from dtwin.schema import Floats


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    if not moves(state, axis):
        return np.zeros((state.n, 2))
    decay = np.exp(-state.since_reversal_s[axis] * 1e3 / shape["duration_ms"])
    end = state.last_end[axis]
    out = decay * end * state.sensitivity[axis]
    return stacked(np.where(end > 0, out, 0.0), np.where(end < 0, out, 0.0))


EFFECT = Effect(
    name="reversal_spike",
    title="Reversal spike",
    parameters=(
        Parameter("height_at_positive_end", "um", 5.0),
        Parameter("height_at_negative_end", "um", 5.0),
    ),
    regressors=_columns,
    law=Law(None, None, "even"),
    meaning="Static friction holds the axis at reversal until the servo has built up torque.",
    formula="A exp(-t_r / T) after each reversal of the axis",
    looks_like=(
        "Short spike outwards or inwards just after the reversal, on the other side of the "
        "axis when the direction changes."
    ),
    separate_by="Lower the feed: the spike shrinks and a backlash step stays.",
    remedy="Friction compensation of the control, lubrication, loop gain.",
    reference=(
        "JSME quadrant glitch measurements over radii and feeds; ISO 230-4:2022 annex B, "
        "influence of typical machine errors on circular paths"
    ),
    shapes=(ShapeParameter("duration_ms", "ms", 60.0, (8.0, 20.0, 50.0, 120.0, 300.0)),),
    confusables=(
        "friction",
        "reversal_ringing",
        "backlash",
    ),
    correctable="Friction compensation of the control; an offset is usually too slow.",
)
