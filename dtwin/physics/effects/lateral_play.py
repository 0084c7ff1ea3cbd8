"""An axis moves sideways when it reverses."""

from __future__ import annotations

import numpy as np

from dtwin.physics.effect import SECOND_AXIS, Effect, Law, Parameter, Shape, aside, moves
from dtwin.physics.state import State
from dtwin.schema import Floats


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    if not moves(state, axis):
        return np.zeros((state.n, 2))
    return aside(state, axis, 0.5 * np.sign(state.velocity_mm_s[axis]))


EFFECT = Effect(
    name="lateral_play",
    title="Lateral play",
    group="geometry",
    parameters=(Parameter("play", "um", 3.0), Parameter("second_axis_play", "um", 3.0, once="play")),
    regressors=_columns,
    law=Law(0.0, 0.0, "odd"),
    meaning=("Play in the guideway: the carriage tips or shifts at right angles to its motion when it reverses."),
    formula="-d (L / 2) |sin(t)| for the X axis" + SECOND_AXIS,
    looks_like=("Radius differs between the directions, with lobes; never a step where the axis itself reverses."),
    separate_by=("Compare both directions at one set-up: backlash steps at its own reversal, play does not."),
    remedy="Adjust or renew guideway, gibs or preload of the carriages.",
    reference="ISO 230-4:2022 annex B, influence of typical machine errors on circular paths",
    confusables=("backlash", "lateral_play_taper"),
    correctable="An offset of the other axis that jumps with the direction of this one.",
)
