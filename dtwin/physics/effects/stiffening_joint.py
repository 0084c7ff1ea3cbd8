"""A joint that grows stiffer under load: the mode of the structure moves up with the amplitude."""

from __future__ import annotations

import numpy as np

from dtwin.physics._second_order import answer_to_tone
from dtwin.physics.effect import Effect, Law, Parameter, Shape, ShapeParameter, moves
from dtwin.physics.state import State
from dtwin.schema import Floats


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    if not moves(state, axis):
        return np.zeros((state.n, 2))
    load_m_s2 = 1e-3 * state.feed_mm_s**2 / state.radius_mm
    stiffer = load_m_s2 ** min(shape["stiffening"], 1.0)
    return answer_to_tone(state, axis, shape["frequency_hz"] * stiffer, shape["damping"])


EFFECT = Effect(
    name="stiffening_joint",
    title="Stiffening joint",
    group="dynamics",
    parameters=(Parameter("with_acceleration", "1", 0.2), Parameter("with_velocity", "1", 0.05)),
    regressors=_columns,
    law=Law(None, None, "even"),
    meaning="Rough faces of a joint touch at more and more places as the inertia presses on them.",
    formula="a s^2 / D + b s w / D, D = s^2 + 2 z w s + w^2, w = w1 (A w^2 / (1 m/s2))^q",
    looks_like="The relative error falls with the amplitude, most where the frequency is high.",
    separate_by="Measure more amplitudes at the highest frequency: a mode is in proportion to them.",
    remedy="Preload or scrape the joint; a correction that knows the amplitude.",
    reference="[D] describing function of a power-law spring in a second-order mode",
    kinds=("sinusoidal",),
    shapes=(
        ShapeParameter("frequency_hz", "Hz", 80.0, (60.0, 80.0, 110.0, 150.0)),
        ShapeParameter("damping", "1", 0.05, (0.03, 0.1)),
        ShapeParameter("stiffening", "1", 0.1, (0.05, 0.1, 0.2)),
    ),
    also_tried=tuple(
        {"frequency_hz": frequency_hz, "damping": 0.05, "stiffening": 0.1}
        for frequency_hz in (12.0, 30.0, 250.0, 500.0)
    ),
    confusables=("structural_mode", "servo_response"),
    told_by="amplitude",
    correctable="A correction as a function of frequency and amplitude.",
)
