"""Friction in the guideway, as far as the position loop lets it through."""

from __future__ import annotations

import numpy as np

from dtwin.physics._second_order import answer_to_force
from dtwin.physics.effect import Effect, Law, Parameter, Shape, ShapeParameter, moves, travelled_mm
from dtwin.physics.state import State
from dtwin.schema import Floats


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    if not moves(state, axis):
        return np.zeros((state.n, 1))
    travelled_um = 1e3 * travelled_mm(state, axis)
    turned = 1.0 - 2.0 * np.exp(-travelled_um / shape["presliding_um"])
    force = -np.sign(state.velocity_mm_s[axis]) * turned
    lag = answer_to_force(state, force, shape["loop_hz"], shape["damping"])
    return (lag * state.sensitivity[axis])[:, None]


EFFECT = Effect(
    name="guideway_friction",
    title="Guideway friction",
    group="drive",
    parameters=(Parameter("deflection", "um", 0.2),),
    regressors=_columns,
    law=Law(None, None, "even"),
    meaning=(
        "Friction turns round with the motion, over some travel; the position loop gives way to it "
        "by its stiffness, and rings."
    ),
    formula="-L w^2 / D acting on sgn(v) (1 - 2 exp(-s / sp))",
    looks_like="Odd harmonics of the tone, of much the same size at all amplitudes and frequencies.",
    separate_by="Halve the amplitude: errors in proportion to it halve, friction stays.",
    remedy="Lubrication, hydrostatic guideways, higher gain, friction compensation.",
    reference="[D] pre-sliding friction in a second-order loop; Armstrong-Helouvry et al. 1994",
    kinds=("sinusoidal",),
    shapes=(
        ShapeParameter("presliding_um", "um", 0.4, (0.1, 0.4, 1.5)),
        ShapeParameter("loop_hz", "Hz", 80.0, (50.0, 80.0, 130.0, 210.0)),
        ShapeParameter("damping", "1", 0.3, (0.15, 0.5)),
    ),
    # From small slides to tables of machines.
    also_tried=tuple(
        {"presliding_um": travel_um, "loop_hz": loop_hz, "damping": 0.3}
        for travel_um, loops_hz in ((0.4, (15.0, 500.0)), (6.0, (15.0, 50.0, 130.0)), (25.0, (15.0, 50.0, 130.0)))
        for loop_hz in loops_hz
    ),
    confusables=("backlash", "tracking_delay"),
    correctable="A pulse or offset at each reversal; better friction compensation in the loop.",
)
