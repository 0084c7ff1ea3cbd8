"""An axis moves along a guideway of any smooth shape."""

from __future__ import annotations

from functools import partial

from dtwin.physics.effect import OVER, SECOND_AXIS, Effect, Law, Parameter, Shape, guideway
from dtwin.physics.state import State
from dtwin.schema import Floats

_ORDERS = (3, 4, 5)


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    return guideway(state, axis, shape[OVER.name], *(partial(_power, order=order) for order in _ORDERS))


def _power(x_mm: Floats, order: int) -> Floats:
    u = out = x_mm / 100.0
    # A power of an array takes twenty times as long as its products.
    for _ in range(order - 1):
        out = out * u
    return out


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
        "(a u^3 + b u^4 + c u^5) sin(t), u = x / 100 mm, less the least-squares line and bow over the largest circle, for "
        "the X axis" + SECOND_AXIS
    ),
    looks_like="Smooth lobes, the same at all feeds and in both directions, that follow the place along the axis.",
    separate_by="Circles of another radius: what follows the place keeps its place on the axis, not its angle.",
    remedy="Check guideway and alignment of the bed, or enter a straightness table.",
    reference="ISO 230-1, straightness error motion",
    shapes=(OVER,),
    confusables=("straightness", "gravity_sag", "instrument_artefact"),
    correctable="A compensation value of the control, or an offset of position.",
)
