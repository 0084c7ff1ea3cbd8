"""An axis moves along a bow."""

from __future__ import annotations

import numpy as np

from dtwin.physics.effect import SECOND_AXIS, Effect, Law, Parameter, Shape, aside, moves
from dtwin.physics.state import State
from dtwin.schema import Floats


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    return aside(state, axis, (state.position_mm[axis] / 100.0) ** 2) if moves(state, axis) else np.zeros((state.n, 2))


EFFECT = Effect(
    name="straightness",
    title="Straightness",
    group="geometry",
    parameters=(
        Parameter("bow_at_100_mm", "um", 5.0),
        Parameter("second_axis_bow_at_100_mm", "um", 5.0, once="bow_at_100_mm"),
    ),
    regressors=_columns,
    law=Law(0.0, 2.0, "even"),
    meaning=("The guideway of the axis is bowed: the other axis is pushed aside by the square of the position."),
    formula="s (x / 100 mm)^2 sin(t) for the X axis" + SECOND_AXIS,
    looks_like=(
        "Three smooth lobes, the same at all feeds and in both directions; changes with the "
        "place in the working volume."
    ),
    separate_by=(
        "Seat the bar again: three lobes of a dirty cup change, those of a guideway stay. A lead of the other axis that "
        "changes evenly along its travel looks exactly alike on every circle of this plane: a laser along that axis tells."
    ),
    remedy="Check guideway and alignment of the bed, or enter a straightness table.",
    reference="ISO 230-4:2022 annex B, influence of typical machine errors on circular paths",
    confusables=("instrument_artefact", "gravity_sag", "guideway_shape"),
    correctable="A compensation value of the control, or an offset of position.",
)
