"""An axis moves along a guideway of any smooth shape."""

from __future__ import annotations

import numpy as np

from dtwin.physics.effect import SECOND_AXIS, Effect, Law, Parameter, Shape, ShapeParameter, aside, moves
from dtwin.physics.state import State
from dtwin.schema import Floats

_ORDERS = (3, 4, 5)
# Of the least-squares line or bow of each order over -1 to 1.
_LINE_OR_BOW = {3: 3.0 / 5.0, 4: 6.0 / 7.0, 5: 3.0 / 7.0}


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    if not moves(state, axis):
        return np.zeros((state.n, 2 * len(_ORDERS)))
    along = state.position_mm[axis] / 100.0
    profiles = []
    for order in _ORDERS:
        simple = 1 + (order + 1) % 2
        over = shape[("line_over_mm", "bow_over_mm")[simple - 1]] / 100.0
        profiles.append(along**order - _LINE_OR_BOW[order] * over ** (order - simple) * along**simple)
    return aside(state, axis, *profiles)


EFFECT = Effect(
    name="guideway_shape",
    title="Shape of a guideway",
    group="geometry",
    parameters=tuple(
        Parameter(f"{side}order_{order}_at_100_mm", "um", 5.0) for side in ("", "second_axis_") for order in _ORDERS
    ),
    regressors=_columns,
    law=Law(0.0, None, "even"),
    meaning=(
        "The other axis is pushed aside by a smooth function of the position that is no arc: the guideway is bent so, "
        "or a hose or chain pulls by where the axis is."
    ),
    formula=(
        "(a u^3 + b u^4 + c u^5) sin(t), u = x / 100 mm, for the X axis, less the least-squares line of u^3 and u^5 over "
        "the circles where squareness is fitted too, and the bow of u^4 beside straightness" + SECOND_AXIS
    ),
    looks_like="Smooth lobes, the same at all feeds and in both directions, that follow the place along the axis.",
    separate_by="Circles of another radius: what follows the place keeps its place on the axis, not its angle.",
    remedy="Check guideway and alignment of the bed, or enter a straightness table.",
    reference="ISO 230-1, straightness error motion",
    shapes=tuple(
        ShapeParameter(name, "mm", 0.0, (0.0,), (0.0, 1e4), refined=False) for name in ("line_over_mm", "bow_over_mm")
    ),
    confusables=("straightness", "gravity_sag", "instrument_artefact"),
    correctable="A compensation value of the control, or an offset of position.",
)
