"""The gear of a joint leaves a ripple per turn of the joint."""

from __future__ import annotations

import numpy as np

from dtwin.physics.effect import Effect, Law, Parameter, Shape, ShapeParameter, stacked
from dtwin.physics.state import State
from dtwin.schema import Floats


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    motion = state.joints
    number = int(axis) - 1
    phase = shape["order"] * motion.q_rad[:, number]
    lever = 1e-3 * motion.lever_mm[:, number]
    return stacked(lever * np.cos(phase), lever * np.sin(phase))


EFFECT = Effect(
    name="joint_cyclic",
    title="Cyclic error of a joint",
    group="drive",
    parameters=(Parameter("cosine", "urad", 30.0), Parameter("sine", "urad", 30.0)),
    regressors=_columns,
    law=Law(0.0, None, "even"),
    meaning=(
        "Transmission error of a joint gear, or eccentricity of its encoder: repeats with the angle of the joint."
    ),
    formula="E cos(N q + f) times the lever of the joint",
    looks_like="Ripple whose density follows the speed of the joint.",
    separate_by="Change the feed: ripple locked to the joint angle stays where it is.",
    remedy="Joint-side table by angle.",
    reference="[D] transmission error through the Jacobian",
    per="joint",
    shapes=(ShapeParameter("order", "1/turn", 1.0, (1.0, 2.0, *range(8, 104, 8), 200.0)),),
    confusables=("cyclic_error", "joint_offset"),
    correctable="A table by joint angle, or its projection on the path.",
)
