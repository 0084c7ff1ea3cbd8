"""The set-up drifts with time."""

from __future__ import annotations

import numpy as np

from dtwin.physics.effect import SETTLING, Effect, Law, Parameter, Shape, settled_h, stacked
from dtwin.physics.state import State
from dtwin.schema import Floats


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    time_h = settled_h(state, shape)
    shift = [time_h * state.sensitivity[a] if a in state.axes else np.zeros(state.n) for a in "XYZ"]
    # Only a circle has a radius; along an axis that would be the same as its shift.
    length = time_h if state.plane else np.zeros(state.n)
    return stacked(*shift, length)


EFFECT = Effect(
    name="thermal_drift",
    title="Drift",
    group="heat",
    parameters=(
        Parameter("shift_x", "um/h", 5.0),
        Parameter("shift_y", "um/h", 5.0),
        Parameter("shift_z", "um/h", 5.0),
        Parameter("radius", "um/h", 5.0),
    ),
    regressors=_columns,
    law=Law(0.0, 0.0, "even"),
    meaning=(
        "Centre and radius, or the zero of an axis, move with time: heat of the structure, creep of the set-up, a coupling "
        "or an encoder that slips, lost steps, or wear over days. It slows down with the time constant S; at 10 000 h it "
        "does not."
    ),
    formula="S (1 - exp(-h / S)) (a cos(t) + b sin(t) + c), h in hours since the first run",
    looks_like="The start and the end of the circle do not meet; repeats wander in one direction.",
    separate_by=("Stop for twenty minutes and measure again: drift with time goes on, thermal growth turns back."),
    remedy=(
        "Where a thermometer moves with it: warm up, wait for the set-up to settle, shorten the test. Else mark the "
        "coupling and the encoder: they slip, or steps are lost."
    ),
    reference="ISO 230-3",
    per="machine",
    kinds=("circular", "linear", "sinusoidal"),
    shapes=(SETTLING,),
    confusables=("thermal_growth", "centre_offset"),
    within_condition=True,
)
