"""Play that is larger where the screw is worn."""

from __future__ import annotations

import numpy as np

from dtwin.physics.effect import Effect, Law, Parameter, Shape, ShapeParameter, moves
from dtwin.physics.state import State
from dtwin.schema import Floats

_MOST = 0.5


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    if not moves(state, axis):
        return np.zeros((state.n, 1))
    position_mm = state.position_mm[axis]
    travel_mm = max(float(np.ptp(position_mm)), 1e-9)
    share = (position_mm - position_mm.min()) / travel_mm
    # Beyond half the travel it would be backlash under another name.
    reach = min(shape["reach_of_travel"], _MOST)
    off = np.clip((share - shape["place_of_travel"]) / reach, -1.0, 1.0)
    worn = 0.5 * (1.0 + np.cos(np.pi * off))
    return (-0.5 * np.sign(state.velocity_mm_s[axis]) * worn * state.sensitivity[axis])[:, None]


EFFECT = Effect(
    name="worn_screw",
    title="Worn stretch of a screw",
    parameters=(Parameter("additional_backlash", "um", 5.0),),
    regressors=_columns,
    law=Law(0.0, None, "odd"),
    meaning="The screw is worn where the slide works most: the play is larger there.",
    formula="-(dB / 2) sgn(v) (1 + cos(pi (x - x0) / w)) / 2 within w of x0",
    looks_like="The two directions part further over a stretch of the travel.",
    separate_by="Measure in both directions with targets closer together over that stretch.",
    remedy="Renew the screw; until then a table of backlash by position, or work elsewhere.",
    reference="ISO 230-2: reversal error by position",
    kinds=("linear",),
    shapes=(
        ShapeParameter("place_of_travel", "1", 0.5, (0.1, 0.25, 0.4, 0.55, 0.7, 0.85), (0.01, 1.0)),
        ShapeParameter("reach_of_travel", "1", 0.2, (0.08, 0.2, 0.4), (0.01, 1.0)),
    ),
    confusables=("backlash_taper", "backlash"),
    correctable="A table of backlash by position.",
)
