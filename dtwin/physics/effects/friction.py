"""Friction rises where the axis is slow."""

from __future__ import annotations

import numpy as np

from dtwin.physics.effect import Effect, Law, Parameter, Shape, ShapeParameter, moves
from dtwin.physics.state import State
from dtwin.schema import Floats


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    if not moves(state, axis):
        return np.zeros((state.n, 1))
    speed = state.velocity_mm_s[axis]
    held = np.exp(-np.abs(speed) / shape["stribeck_mm_s"])
    return (-0.5 * np.sign(speed) * held * state.sensitivity[axis])[:, None]


EFFECT = Effect(
    name="friction",
    title="Friction at low speed",
    parameters=(Parameter("extra_lag", "um", 3.0),),
    regressors=_columns,
    law=Law(None, None, "odd"),
    meaning=(
        "Friction is higher at low speed (Stribeck): the axis lags more before and after "
        "each reversal than in between."
    ),
    formula="-(H / 2) sgn(v) exp(-|v| / vs) cos(t) for the X axis",
    looks_like="Humps of opposite sign on both sides of a reversal; narrower at higher feed.",
    separate_by="Change the feed: its width in degrees shrinks, backlash keeps its plateau.",
    remedy="Lubrication, friction compensation.",
    reference="Stribeck friction; JSME quadrant glitch measurements",
    shapes=(ShapeParameter("stribeck_mm_s", "mm/s", 5.0, (2.0, 5.0, 12.0)),),
    confusables=(
        "backlash",
        "reversal_spike",
    ),
    correctable="Friction compensation of the control.",
)
