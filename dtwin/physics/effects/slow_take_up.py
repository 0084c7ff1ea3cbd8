"""Lost motion that is not all taken up when an axis reaches the first targets after it turned round."""

from __future__ import annotations

import numpy as np

from dtwin.physics.effect import Effect, Law, Parameter, Shape, ShapeParameter, moves, travelled_mm
from dtwin.physics.state import State
from dtwin.schema import Floats

# Beyond this share of the travel it would be a curve of both directions under another name.
_MOST = 0.25


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    if not moves(state, axis):
        return np.zeros((state.n, 1))
    position_mm = state.position_mm[axis]
    since_mm = travelled_mm(state, axis)
    # How far the axis turned round before the first target is not known, and is a part of the size.
    since_mm = since_mm - since_mm.min()
    way_mm = min(shape["way_mm"], _MOST * max(float(np.ptp(position_mm)), 1e-9))
    lacks = 0.5 * np.sign(state.velocity_mm_s[axis]) * np.exp(-since_mm / way_mm)
    return (lacks * state.sensitivity[axis])[:, None]


EFFECT = Effect(
    name="slow_take_up",
    title="Lost motion taken up slowly",
    group="drive",
    parameters=(Parameter("lacking_at_first_target", "um", 5.0),),
    regressors=_columns,
    law=Law(0.0, None, "odd"),
    meaning=(
        "After it turned round the axis takes up its lost motion over some way: drive, screw or slide give elastically, or "
        "a hose or a seal drags. The first targets of each sweep are read before all of it is taken up."
    ),
    formula="(U / 2) sgn(v) exp(-s / w), s from the first target of the sweep",
    looks_like="The first reading or readings after each reversal are off, at the near end forward and at the far end in reverse.",
    separate_by="Turn round further beyond the last target: what is taken up before the first one is read is gone.",
    remedy="Lengthen the overrun; look for what gives or drags: preload of nut and bearings, friction of the guideway, seals, hoses.",
    reference="ISO 230-2",
    kinds=("linear",),
    shapes=(ShapeParameter("way_mm", "mm", 5.0, (3.0, 10.0, 35.0, 120.0), (0.5, 300.0), ends=True, vanishes=True),),
    confusables=("backlash", "backlash_taper", "worn_screw", "lead_error"),
    special_cases=("lead_error",),
)
