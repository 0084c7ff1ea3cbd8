"""The part of a lead screw's error within a turn that changes with the side on which the nut bears."""

from __future__ import annotations

from dtwin.physics.effect import Effect, Law, Parameter, Shape
from dtwin.physics.screw import ORDERS, PITCH, screw_waves
from dtwin.physics.state import State
from dtwin.schema import Floats


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    return 0.5 * state.direction * screw_waves(state, axis)


EFFECT = Effect(
    name="screw_error_by_direction",
    title="Screw error within a turn that depends on direction",
    group="drive",
    parameters=tuple(
        Parameter(f"{part}_{order}", "um", 5.0 / order) for order in range(1, ORDERS + 1) for part in ("cosine", "sine")
    ),
    regressors=_columns,
    law=Law(0.0, None, "odd"),
    meaning=(
        "The two flanks of the thread have forms of their own, or the nut is tilted: pushed up, the "
        "slide follows one of them, pushed down the other. Needs machine_geometry.screw_pitch_mm."
    ),
    formula="(d / 2) sum over k = 1 to 4 of C_k cos(2 pi k x / p) + S_k sin(2 pi k x / p)",
    looks_like="The backlash swings within each turn of the screw.",
    separate_by="Measure ten targets in each of some turns, in both directions.",
    remedy="Renew nut or screw; a compensation for each direction, that remembers the last reversal.",
    reference="ISO 230-2; ISO 230-1:2012, periodic errors of linear axes",
    kinds=("linear",),
    stated=(PITCH,),
    confusables=("screw_error", "backlash"),
    correctable="A function of position and direction; between the flanks it must hold its value.",
)
