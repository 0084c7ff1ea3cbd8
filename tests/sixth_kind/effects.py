"""What may be wrong with a rotary table."""

from __future__ import annotations

import numpy as np

from dtwin.physics.effect import Effect, Law, Parameter, Shape, stacked
from dtwin.physics.state import State
from dtwin.schema import Floats

TEETH = 24


def _waves(state: State, times: int) -> Floats:
    return stacked(np.cos(times * state.angle_rad), np.sin(times * state.angle_rad))


def _off_centre(state: State, axis: str, shape: Shape) -> Floats:
    return _waves(state, 1)


def _worm(state: State, axis: str, shape: Shape) -> Floats:
    return _waves(state, TEETH)


def _effect(name: str, title: str, regressors: object, meaning: str) -> Effect:
    return Effect(
        name=name,
        title=title,
        regressors=regressors,
        meaning=meaning,  # type: ignore[arg-type]
        parameters=(Parameter("cosine", "um", 5.0), Parameter("sine", "um", 5.0)),
        law=Law(0.0, None, "even"),
        kinds=("turntable",),
        formula="C cos(n t + f)",
        looks_like="A wave.",
        separate_by="Count the waves of a turn.",
        remedy="Set it right.",
        reference="ISO 230-7",
    )


OFF_CENTRE = _effect("off_centre", "Table off centre", _off_centre, "The scale is off centre.")
WORM_ERROR = _effect("worm_error", "Error of the worm", _worm, "A tooth passes with each wave.")
