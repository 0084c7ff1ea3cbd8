"""The zero of the instrument is not the zero of the axis."""

from __future__ import annotations

import numpy as np

from dtwin.physics.effect import Effect, Law, Parameter, Shape
from dtwin.physics.state import State
from dtwin.schema import Floats


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    return np.ones((state.n, 1))


EFFECT = Effect(
    name="datum_offset",
    title="Datum offset",
    group="instrument",
    parameters=(Parameter("datum", "um", 5.0),),
    regressors=_columns,
    law=Law(0.0, 0.0, "even"),
    meaning="Where the instrument was set to zero: at another error of the axis than zero.",
    formula="c, the same everywhere",
    looks_like="The curve is shifted as a whole.",
    separate_by="Set the instrument to zero again: it changes, errors of the machine do not.",
    remedy="None: it belongs to the set-up.",
    reference="ISO 230-2: errors are relative to a datum",
    per="machine",
    kinds=("linear", "sinusoidal"),
    confusables=("thermal_drift",),
    setup=True,
)
