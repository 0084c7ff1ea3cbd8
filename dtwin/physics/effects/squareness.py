"""Two axes are not at right angles."""

from __future__ import annotations

import numpy as np

from dtwin.physics.effect import Effect, Law, Parameter, Shape
from dtwin.physics.state import State
from dtwin.schema import Floats


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    if axis != state.plane:
        return np.zeros((state.n, 1))
    first, second = state.axes
    return (-1e-3 * state.position_mm[second] * state.sensitivity[first])[:, None]


EFFECT = Effect(
    name="squareness",
    title="Squareness",
    group="geometry",
    parameters=(Parameter("squareness", "um/m", 20.0),),
    regressors=_columns,
    law=Law(0.0, 1.0, "even"),
    meaning="The axes of the plane are not at right angles.",
    formula="-(q R / 2) sin(2t), q in µm/m",
    looks_like="Oval along 45 or 135 degrees, the same in both directions.",
    separate_by="Reverse the direction: the oval of a servo mismatch turns over, this one stays.",
    remedy="Align the axes, or enter the squareness in the compensation of the control.",
    reference="ISO 230-4:2022 annex B, influence of typical machine errors on circular paths",
    per="plane",
    confusables=("servo_mismatch",),
    correctable="A compensation value of the control, or an offset of position.",
)
