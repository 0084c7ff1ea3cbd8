"""Play that is larger where the screw is worn."""

from __future__ import annotations

import numpy as np

from dtwin.physics.effect import Effect, Law, Parameter, Shape, ShapeParameter, moves
from dtwin.physics.state import State
from dtwin.schema import Floats

_MOST = 0.5
_EVEN = 0.9


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    if not moves(state, axis):
        return np.zeros((state.n, 1))
    position_mm = state.position_mm[axis]
    travel_mm = max(float(np.ptp(position_mm)), 1e-9)
    share = (position_mm - position_mm.min()) / travel_mm
    # Beyond half the travel it would be backlash under another name.
    reach = min(shape["reach_of_travel"], _MOST)
    # Worn evenly in the middle, less and less towards the ends of the stretch.
    even = min(shape["even_share"], _EVEN)
    off = np.abs(share - shape["place_of_travel"]) / reach
    worn = 0.5 * (1.0 + np.cos(np.pi * np.clip((off - even) / (1.0 - even), 0.0, 1.0)))
    return (-0.5 * np.sign(state.velocity_mm_s[axis]) * worn * state.sensitivity[axis])[:, None]


EFFECT = Effect(
    name="worn_screw",
    title="Worn stretch of a screw",
    group="drive",
    parameters=(Parameter("additional_backlash", "um", 5.0),),
    regressors=_columns,
    law=Law(0.0, None, "odd"),
    meaning="The screw is worn where the slide works most: the play is larger there.",
    formula="-(dB / 2) sgn(v) within e w of x0, from there to w falling like (1 + cos) / 2",
    looks_like="The two directions part further over a stretch of the travel.",
    separate_by="Measure in both directions with targets closer together over that stretch.",
    remedy="Renew the screw; until then a table of backlash by position, or work elsewhere.",
    reference="ISO 230-2: reversal error by position",
    kinds=("linear",),
    shapes=(
        ShapeParameter("place_of_travel", "1", 0.5, (0.1, 0.25, 0.4, 0.55, 0.7, 0.85), (0.01, 1.0)),
        ShapeParameter("reach_of_travel", "1", 0.2, (0.08, 0.2, 0.4), (0.01, 1.0)),
        ShapeParameter("even_share", "1", 0.1, (0.05, 0.6), (0.0, 0.9)),
    ),
    confusables=("backlash_taper", "backlash"),
    correctable="A table of backlash by position.",
)
