"""The drive lags by what it takes to overcome friction."""

from __future__ import annotations

import numpy as np

from dtwin.physics.effect import Effect, Law, Parameter, Shape, ShapeParameter, moves, stacked
from dtwin.physics.state import State
from dtwin.schema import Floats
from dtwin.units import UM_PER_MM


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    if not moves(state, axis):
        return np.zeros((state.n, 2))
    # The drive answers as late as its position loop: what it does now belongs to where the circle was then.
    per_s = state.feed_mm_s / state.radius_mm
    cos, sin = np.cos(per_s * shape["response_ms"] / 1e3), np.sin(per_s * shape["response_ms"] / 1e3)
    position = cos * state.position_mm[axis] - sin * state.velocity_mm_s[axis] / per_s
    speed = cos * state.velocity_mm_s[axis] + sin * per_s * state.position_mm[axis]
    # Before it slides, friction builds up over some micrometres of travel since the last reversal.
    travelled_um = UM_PER_MM * (state.radius_mm + np.sign(speed) * position)
    sliding = 1.0 - 2.0 * np.exp(-travelled_um / shape["presliding_um"])
    slow = np.exp(-((speed / shape["stribeck_mm_s"]) ** 2))
    lag = -0.5 * np.sign(speed) * sliding * state.sensitivity[axis]
    return stacked(lag, lag * slow)


EFFECT = Effect(
    name="friction",
    title="Friction",
    group="drive",
    parameters=(Parameter("lag", "um", 3.0), Parameter("extra_lag_when_slow", "um", 3.0)),
    regressors=_columns,
    law=Law(None, None, "odd"),
    meaning=(
        "The drive lags by what it takes to overcome friction: like backlash once it slides, but "
        "built up over some travel, larger at low speed (Stribeck), and late by the time of the position loop."
    ),
    formula="-(sgn(v) / 2) (1 - 2 exp(-s / sp)) (L + H exp(-(v / vs)^2)) cos(t) for the X axis, as it was a time T before",
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
        ShapeParameter("response_ms", "ms", 0.1, (3.0, 30.0), (0.0, 200.0), by_speed=True),
    ),
    confusables=("backlash", "reversal_spike"),
    correctable="Friction compensation of the control.",
)
