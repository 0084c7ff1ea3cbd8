"""The length of the bar is not known, or all axes scale alike."""

from __future__ import annotations

import numpy as np

from dtwin.physics.effect import Effect, Law, Parameter, Shape
from dtwin.physics.state import State
from dtwin.schema import Floats


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    return np.ones((state.n, 1))


EFFECT = Effect(
    name="radius_offset",
    title="Radius offset",
    group="instrument",
    parameters=(Parameter("radius", "um", 5.0),),
    regressors=_columns,
    law=Law(0.0, 0.0, "even"),
    meaning=("The length of the bar differs from the nominal radius; a scale error common to all axes looks the same."),
    formula="c, the same at every angle",
    looks_like="The circle is larger or smaller everywhere.",
    separate_by="Calibrate the bar, or use two bar lengths.",
    remedy="None: it belongs to the set-up.",
    reference="ISO 230-4:2022 annex B, influence of typical machine errors on circular paths",
    per="machine",
    confusables=("servo_lag", "inertial_compliance", "thermal_growth"),
    setup=True,
)
