"""The control changes its leading axis at 45 degrees."""

from __future__ import annotations

import numpy as np

from dtwin.physics.effect import Effect, Law, Parameter, Shape
from dtwin.physics.state import State
from dtwin.schema import Floats


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    if axis != state.plane:
        return np.zeros((state.n, 1))
    first, second = state.axes
    gap = np.abs(state.sensitivity[first]) - np.abs(state.sensitivity[second])
    return np.sign(gap)[:, None]


EFFECT = Effect(
    name="axis_changeover",
    title="Axis changeover",
    group="drive",
    parameters=(Parameter("step", "um", 2.0),),
    regressors=_columns,
    law=Law(0.0, 0.0, "even"),
    meaning=("The leading axis of the interpolation changes four times per turn, with a step in radius."),
    formula="M sgn(|cos(t)| - |sin(t)|)",
    looks_like="Steps at 45, 135, 225 and 315 degrees.",
    separate_by="Turn the circle in the plane, if the control allows: the steps stay with the axes.",
    remedy="Parameters of the interpolator; ask the maker of the control.",
    reference="ISO 230-4:2022 annex B, influence of typical machine errors on circular paths",
    per="plane",
    confusables=("scale_mismatch", "inertial_compliance"),
    correctable="An offset by angle.",
)
