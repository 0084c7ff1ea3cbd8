"""A guideway has a wave."""

from __future__ import annotations

import numpy as np

from dtwin.physics.effect import OVER, SECOND_AXIS, Effect, Law, Parameter, Shape, ShapeParameter, guideway
from dtwin.physics.state import State
from dtwin.schema import Floats

# Half a turn apart at the end of a metre, as those of a pitch error; longer ones are lines and bows to a ball bar.
_WAVES_MM = tuple(2000.0 / n for n in range(8, 41))


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    per_mm = 2.0 * np.pi / shape["wave_mm"]
    return guideway(
        state, axis, shape[OVER.name], lambda x_mm: np.cos(per_mm * x_mm), lambda x_mm: np.sin(per_mm * x_mm)
    )


EFFECT = Effect(
    name="guideway_wave",
    title="Wave of a guideway",
    group="geometry",
    parameters=tuple(
        Parameter(f"{side}{part}", "um", 5.0) for side in ("", "second_axis_") for part in ("cosine", "sine")
    ),
    regressors=_columns,
    law=Law(0.0, None, "even"),
    meaning=(
        "The other axis is pushed aside by a wave along the axis: the guideway is drawn to its bed by screws that stand "
        "some way apart, or was ground so."
    ),
    formula=(
        "C cos(2 pi x / w + f) sin(t), less its least-squares line and bow over the largest circle, for the X axis"
        + SECOND_AXIS
    ),
    looks_like=(
        "A few smooth lobes that follow the place along the axis, the same in both directions and at every feed; largest "
        "where the other axis turns back."
    ),
    separate_by="Circles of another radius, on which a wave keeps its length, or a straightedge along the axis.",
    remedy="Check guideway and its screws, or enter a straightness table.",
    reference="ISO 230-1, straightness error motion",
    shapes=(ShapeParameter("wave_mm", "mm", 200.0, _WAVES_MM, (20.0, 400.0), step_on_circles=2), OVER),
    confusables=("guideway_shape", "straightness", "instrument_artefact", "pitch_error"),
    told_by="radius",
    correctable="A compensation value of the control, or an offset of position.",
)
