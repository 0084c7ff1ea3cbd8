"""The error of a lead screw within each of its turns."""

from __future__ import annotations

from dtwin.physics.effect import Effect, Law, Parameter, Shape
from dtwin.physics.screw import ORDERS, PITCH, screw_waves
from dtwin.physics.state import State
from dtwin.schema import Floats


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    return screw_waves(state, axis)


EFFECT = Effect(
    name="screw_error",
    title="Screw error within a turn",
    group="drive",
    parameters=tuple(
        Parameter(f"{part}_{order}", "um", 5.0 / order) for order in range(1, ORDERS + 1) for part in ("cosine", "sine")
    ),
    regressors=_columns,
    law=Law(0.0, None, "even"),
    meaning=(
        "Screw, its bearing or its encoder run out: the same error in every turn, on whichever side "
        "the nut bears. Needs machine_geometry.screw_pitch_mm."
    ),
    formula="sum over k = 1 to 4 of C_k cos(2 pi k x / p) + S_k sin(2 pi k x / p)",
    looks_like="Waves of the pitch and of its parts, the same in both directions.",
    separate_by="Measure ten targets in each of some turns, in both directions.",
    remedy="Align bearing and screw; a compensation with ten or more values in a turn.",
    reference="ISO 230-2; ISO 230-1:2012, periodic errors of linear axes",
    kinds=("linear",),
    stated=(PITCH,),
    confusables=("screw_error_by_direction", "pitch_error"),
    correctable="A table or function of the position with steps well below the pitch.",
)
