"""A joint gives way to gravity."""

from __future__ import annotations

from dtwin.physics.effect import Effect, Law, Parameter, Shape
from dtwin.physics.state import State
from dtwin.schema import Floats


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    motion = state.joints
    number = int(axis) - 1
    sag = 1e-3 * motion.gravity_nmm[:, number]
    return (1e-3 * sag * motion.lever_mm[:, number])[:, None]


EFFECT = Effect(
    name="joint_compliance",
    title="Compliance of a joint",
    group="dynamics",
    parameters=(Parameter("compliance_per_kg", "urad/(N m)/kg", 20.0),),
    regressors=_columns,
    law=Law(0.0, None, "even"),
    meaning="Gravity turns each joint by its compliance; the moment changes along the path.",
    formula="c M(q) times the lever of the joint, for 1 kg at the tool",
    looks_like="Slow lobes, the same at all feeds and in both directions.",
    separate_by="Repeat with another payload: it follows the load.",
    remedy="Compliance model of the robot with payload and centre of gravity.",
    reference="[D] static joint compliance through the Jacobian",
    per="joint",
    confusables=("joint_offset", "scale_mismatch"),
    correctable="A compensation value of the control, or an offset of position.",
)
