"""A cantilever sags with its overhang."""

from __future__ import annotations

import numpy as np

from dtwin.physics.effect import Effect, Law, Parameter, Shape
from dtwin.physics.state import State
from dtwin.schema import Floats


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    if "Z" not in state.axes or axis not in state.axes or axis == "Z":
        return np.zeros((state.n, 1))
    sag = -((state.position_mm[axis] / 100.0) ** 3)
    return (sag * state.sensitivity["Z"])[:, None]


EFFECT = Effect(
    name="gravity_sag",
    title="Gravity sag",
    group="geometry",
    parameters=(Parameter("sag_at_100_mm", "um", 2.0),),
    regressors=_columns,
    law=Law(0.0, 3.0, "even"),
    meaning=(
        "A ram or arm bends down under its own weight, more the further it reaches out. Its "
        "linear part looks like squareness and its quadratic part like straightness."
    ),
    formula="-s (x / 100 mm)^3 sin(t), in planes with Z",
    looks_like="An S in vertical planes, the same at all feeds.",
    separate_by="Repeat with another load at the tool: sag follows the load.",
    remedy="Counterbalance; compensation by overhang.",
    reference="[D] cantilever under its own weight",
    confusables=("straightness", "squareness"),
    correctable="A compensation value of the control, or an offset of position.",
)
