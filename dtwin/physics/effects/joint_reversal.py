"""A joint of a robot lags behind on the side it comes from."""

from __future__ import annotations

import numpy as np

from dtwin.physics.effect import Effect, Law, Parameter, Shape
from dtwin.physics.state import State
from dtwin.schema import Floats


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    motion = state.joints
    number = int(axis) - 1
    lag = -0.5 * np.sign(motion.qd_rad_s[:, number])
    return (1e-3 * lag * motion.lever_mm[:, number])[:, None]


EFFECT = Effect(
    name="joint_reversal",
    title="Joint backlash",
    group="drive",
    parameters=(Parameter("backlash", "urad", 50.0),),
    regressors=_columns,
    law=Law(0.0, None, "odd"),
    meaning=(
        "Play or wind-up of a joint gear: the joint lags on the side it comes from, and the "
        "arm turns that into an error of the tool."
    ),
    formula="-(B / 2) sgn(dq/dt) times the lever of the joint",
    looks_like="Steps where the joint reverses, which is not at 0, 90, 180 or 270 degrees.",
    separate_by="Measure the circle at another place: the joint reverses elsewhere on it.",
    remedy="Renew or preload the gear; joint-side compensation.",
    reference="Slamani, Nubiola, Bonev: ball bar tests of an industrial robot",
    per="joint",
    confusables=("backlash",),
    correctable="Joint offsets by direction, or their projection on the path.",
)
