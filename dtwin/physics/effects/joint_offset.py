"""A joint has a wrong zero."""

from __future__ import annotations

from dtwin.physics.effect import Effect, Law, Parameter, Shape
from dtwin.physics.state import State
from dtwin.schema import Floats


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    motion = state.joints
    number = int(axis) - 1
    return (1e-3 * motion.lever_mm[:, number])[:, None]


EFFECT = Effect(
    name="joint_offset",
    title="Zero offset of a joint",
    group="geometry",
    parameters=(Parameter("offset", "urad", 100.0),),
    regressors=_columns,
    law=Law(0.0, None, "even"),
    meaning=(
        "The zero of a joint encoder is wrong; several joints together can cancel, so only "
        "combinations show on one circle."
    ),
    formula="dq times the lever of the joint",
    looks_like="Slow lobes, the same at all feeds and in both directions.",
    separate_by="Measure circles at other places and heights.",
    remedy="Kinematic calibration of the robot.",
    reference="Slamani, Nubiola, Bonev: ball bar tests of an industrial robot",
    per="joint",
    confusables=("joint_compliance", "scale_mismatch", "squareness"),
    correctable="A compensation value of the control, or an offset of position.",
)
