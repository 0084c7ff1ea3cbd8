"""A slow wave of the screw along its length."""

from __future__ import annotations

import numpy as np

from dtwin.physics.effect import Effect, Law, Parameter, Shape, ShapeParameter, moves, stacked
from dtwin.physics.state import State
from dtwin.schema import Floats

# Waves side by side are half a turn apart at the end of a metre: between them a fit finds its way.
_WAVES_MM = tuple(2000.0 / n for n in range(5, 41))
_MOST = 0.75


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    if not moves(state, axis):
        return np.zeros((state.n, 2))
    position_mm = state.position_mm[axis]
    # What does not turn back within the travel is no wave but a bow.
    wave_mm = min(shape["wave_mm"], _MOST * max(float(np.ptp(position_mm)), 1e-9))
    phase = 2.0 * np.pi * position_mm / wave_mm
    along = state.sensitivity[axis]
    return stacked(along * np.cos(phase), along * np.sin(phase))


EFFECT = Effect(
    name="pitch_error",
    title="Pitch error",
    parameters=(Parameter("cosine", "um", 5.0), Parameter("sine", "um", 5.0)),
    regressors=_columns,
    law=Law(None, None, "even"),
    meaning="The lead of the screw wanders along its length.",
    formula="C cos(2 pi x / w + f)",
    looks_like="A slow wave along the travel, the same in both directions.",
    separate_by="Run in both directions: backlash separates the curves, a pitch error does not.",
    remedy="Pitch error table of the control.",
    reference="ISO 230-2",
    kinds=("linear",),
    shapes=(ShapeParameter("wave_mm", "mm", 200.0, _WAVES_MM),),
    confusables=("lead_error", "cyclic_error"),
    correctable="Pitch error table of the control.",
)
