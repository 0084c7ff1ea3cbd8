"""The structure gives way to the acceleration of the path."""

from __future__ import annotations

import numpy as np

from dtwin.physics.effect import Effect, Law, Parameter, Shape, stacked
from dtwin.physics.state import State
from dtwin.schema import Floats


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    bend = [
        -1e-3 * state.acceleration_mm_s2[a] * state.sensitivity[a] if a in state.axes else np.zeros(state.n)
        for a in "XYZ"
    ]
    return stacked(*bend)


EFFECT = Effect(
    name="inertial_compliance",
    title="Inertial compliance",
    group="dynamics",
    parameters=(
        Parameter("compliance_x", "um/(m/s2)", 5.0, positive=True),
        Parameter("compliance_y", "um/(m/s2)", 5.0, positive=True),
        Parameter("compliance_z", "um/(m/s2)", 5.0, positive=True),
    ),
    regressors=_columns,
    law=Law(2.0, -1.0, "even"),
    meaning="Masses outside the position loop bend the structure under acceleration.",
    formula="F^2 / R (cx cos^2(t) + cy sin^2(t))",
    looks_like="The circle grows when the feed rises; an oval when the axes differ.",
    separate_by="Record the encoders: they do not see it, and they do see a servo lag.",
    remedy="Stiffen, lower acceleration; feed forward of acceleration.",
    reference=(
        "[D] static compliance under inertial load; ISO 230-4:2022 annex B, influence of "
        "typical machine errors on circular paths"
    ),
    per="machine",
    kinds=("circular", "sinusoidal"),
    confusables=("servo_lag", "structural_resonance", "scale_mismatch"),
    correctable="An offset proportional to the commanded acceleration.",
)
