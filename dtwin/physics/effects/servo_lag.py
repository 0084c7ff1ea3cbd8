"""Position loops lose radius with the square of the feed."""

from __future__ import annotations

import numpy as np

from dtwin.physics.effect import Effect, Law, Parameter, Shape, stacked
from dtwin.physics.state import State
from dtwin.schema import Floats


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    loss = [
        0.5e-3 * state.acceleration_mm_s2[a] * state.sensitivity[a] if a in state.axes else np.zeros(state.n)
        for a in "XYZ"
    ]
    return stacked(*loss)


EFFECT = Effect(
    name="servo_lag",
    title="Servo lag (radius loss)",
    group="dynamics",
    parameters=(
        Parameter("squared_delay_x", "ms2", 400.0),
        Parameter("squared_delay_y", "ms2", 400.0),
        Parameter("squared_delay_z", "ms2", 400.0),
    ),
    regressors=_columns,
    law=Law(2.0, -1.0, "even"),
    meaning=(
        "Each position loop follows with a delay; on a circle that costs radius, with the "
        "square of the feed over the radius."
    ),
    formula="-(tau^2 / 2) F^2 / R, for each axis with cos^2(t) and sin^2(t)",
    looks_like=(
        "The circle shrinks when the feed rises; an oval when the axes differ; where it grows (a squared delay below zero), "
        "feed forward is too strong."
    ),
    separate_by="Record the encoders: a servo lag is seen by them, bending of the structure is not.",
    remedy="Feed forward, higher loop gain, lower feed on small radii.",
    reference=(
        "[D] first-order position loop on a circular path; ISO 230-4:2022 annex B, "
        "influence of typical machine errors on circular paths"
    ),
    per="machine",
    confusables=("inertial_compliance", "radius_offset", "structural_resonance", "scale_mismatch"),
    correctable="Radius correction by feed, or feed forward.",
)
