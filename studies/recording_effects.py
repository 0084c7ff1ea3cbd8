"""Effects that need the stops of a path: seen in one recording, not in a mean over angle.

They are not part of the library: their clock is the time since the machine last stood still,
which binned campaigns do not keep.
"""

from __future__ import annotations

import numpy as np

from dtwin.physics.effect import Effect, Law, Parameter, Shape, ShapeParameter, stacked
from dtwin.physics.state import State
from dtwin.schema import Floats

SINCE_STOP = "since_stop_s"
ARC_SHARE = "arc_share_1"
ARC_SIGN = "arc_sign_1"


def _ringing(state: State, axis: str, shape: Shape) -> Floats:
    t_s = state.column(SINCE_STOP)
    # Along the tangent the jerk turns with the direction of motion, towards the centre it does not.
    sign = state.column(ARC_SIGN) * (state.direction if axis == state.axes[1] else 1.0)
    swing = sign * state.sensitivity[axis] * np.exp(-1e3 * t_s / shape["decay_ms"])
    phase = 2.0 * np.pi * shape["frequency_hz"] * t_s
    return stacked(swing * np.cos(phase), swing * np.sin(phase))


def _dip(state: State, axis: str, shape: Shape) -> Floats:
    off = (state.column(ARC_SHARE) - shape["place_1"]) / shape["width_1"]
    bump = np.exp(-0.5 * off**2)
    same, turned = bump, bump * state.column(ARC_SIGN)
    return stacked(same, turned, state.direction * same, state.direction * turned)


STOP_RINGING = Effect(
    name="stop_ringing",
    title="Ringing after a stop",
    parameters=(Parameter("cosine", "um", 10.0), Parameter("sine", "um", 10.0)),
    regressors=_ringing,
    law=Law(None, None, "mixed"),
    meaning="A mode of the structure that the start of every arc excites, and that dies out.",
    formula="A exp(-t / T) cos(2 pi f t + p), t since the last programmed stop",
    looks_like="A decaying wave that begins after every stop.",
    separate_by=("The same circle at half the feed: a mode keeps its frequency, a gear its count per turn."),
    remedy="Blend the arcs instead of stopping between them; lower the acceleration.",
    reference="[D] free damped oscillation",
    needs=(SINCE_STOP, ARC_SIGN),
    shapes=(
        ShapeParameter("frequency_hz", "Hz", 9.4, tuple(n / 5.0 for n in range(25, 101))),
        ShapeParameter("decay_ms", "ms", 1000.0, (250.0, 1000.0, 4000.0)),
    ),
    confusables=("joint_cyclic", "reversal_ringing"),
    correctable="Input shaping; an offset at the rate of the path cannot.",
)

ARC_DIP = Effect(
    name="arc_dip",
    title="Dip within every arc",
    parameters=(
        Parameter("height", "um", 20.0),
        Parameter("height_by_half", "um", 20.0),
        Parameter("height_by_direction", "um", 20.0),
        Parameter("height_by_half_and_direction", "um", 20.0),
    ),
    regressors=_dip,
    law=Law(None, None, "mixed"),
    meaning="A short change of radius at one share of the way from stop to stop; no cause is claimed.",
    formula="H exp(-((s - s0) / w)^2 / 2), s the share of the arc",
    looks_like="A bump or dip at the same share of every arc.",
    separate_by="Programme the stops at other angles: a dip of the arc moves along, one of place stays.",
    remedy="Depends on the cause.",
    reference="[D] description, not a mechanism",
    needs=(ARC_SHARE, ARC_SIGN),
    shapes=(
        ShapeParameter("place_1", "1", 0.5, tuple(n / 40.0 for n in range(2, 39)), (0.005, 0.995)),
        ShapeParameter("width_1", "1", 0.03, (0.015, 0.03, 0.06)),
    ),
    confusables=("reversal_spike", "joint_reversal"),
)
