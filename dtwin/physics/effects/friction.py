"""The drive lags by what it takes to overcome friction."""

from __future__ import annotations

import numpy as np

from dtwin.physics.effect import Effect, Law, Parameter, Shape, ShapeParameter, moves, stacked, travelled_mm
from dtwin.physics.state import State
from dtwin.schema import Floats


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    if not moves(state, axis):
        return np.zeros((state.n, 2))
    speed = state.velocity_mm_s[axis]
    # Before it slides, friction builds up over some micrometres of travel.
    sliding = 1.0 - 2.0 * np.exp(-1e3 * travelled_mm(state, axis) / shape["presliding_um"])
    slow = np.exp(-((speed / shape["stribeck_mm_s"]) ** 2))
    lag = -0.5 * np.sign(speed) * sliding * state.sensitivity[axis]
    return stacked(lag, lag * slow)


EFFECT = Effect(
    name="friction",
    title="Friction",
    parameters=(Parameter("lag", "um", 3.0), Parameter("extra_lag_when_slow", "um", 3.0)),
    regressors=_columns,
    law=Law(None, None, "odd"),
    meaning=(
        "The drive lags by what it takes to overcome friction: like backlash once it slides, but "
        "built up over some travel, and larger at low speed (Stribeck)."
    ),
    formula="-(sgn(v) / 2) (1 - 2 exp(-s / sp)) (L + H exp(-(v / vs)^2)) cos(t) for the X axis",
    looks_like="Rounded steps at the reversals, with humps at low feed.",
    separate_by=(
        "Lower the feed and measure with more samples: a step that is rounded over tens of "
        "micrometres of travel is friction, one within the play is backlash."
    ),
    remedy="Lubrication, loop gain, friction compensation.",
    reference="Canudas de Wit et al. 1995 (LuGre); JSME quadrant glitch measurements",
    shapes=(
        ShapeParameter("presliding_um", "um", 30.0, (15.0, 60.0, 300.0)),
        ShapeParameter("stribeck_mm_s", "mm/s", 5.0, (2.0, 8.0)),
    ),
    confusables=("backlash", "reversal_spike"),
    correctable="Friction compensation of the control.",
)
