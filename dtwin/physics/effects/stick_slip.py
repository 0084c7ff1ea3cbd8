"""An axis moves in jumps when it is slow."""

from __future__ import annotations

import numpy as np

from dtwin.physics.effect import Effect, Law, Parameter, Shape, ShapeParameter, moves
from dtwin.physics.state import State
from dtwin.schema import Floats


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    if not moves(state, axis):
        return np.zeros((state.n, 1))
    slow = np.exp(-((state.velocity_mm_s[axis] / shape["slow_mm_s"]) ** 2))
    return (slow * state.sensitivity[axis] ** 2)[:, None]


EFFECT = Effect(
    name="stick_slip",
    title="Stick-slip",
    group="drive",
    parameters=(Parameter("log_variance", "1", 1.0),),
    regressors=_columns,
    law=Law(None, None, "even"),
    meaning=(
        "Static friction is higher than sliding friction: below some speed the axis sticks "
        "and jumps. It changes the spread of repeats, not their mean."
    ),
    formula="variance rises where |v| < vs",
    looks_like="Rough stretches around reversals at low feed that differ from run to run.",
    separate_by="Raise the feed: it vanishes.",
    remedy="Lubrication, guideway coating, loop gain.",
    reference="Stribeck friction",
    shapes=(ShapeParameter("slow_mm_s", "mm/s", 3.0, (1.0, 3.0, 8.0)),),
    confusables=("friction", "structural_resonance"),
    on_spread=True,
)
