"""Balls, cups and mounting of the bar leave three lobes."""

from __future__ import annotations

import numpy as np

from dtwin.physics.effect import Effect, Law, Parameter, Shape, stacked
from dtwin.physics.state import State
from dtwin.schema import Floats


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    return stacked(np.cos(3.0 * state.angle_rad), np.sin(3.0 * state.angle_rad))


EFFECT = Effect(
    name="instrument_artefact",
    title="Instrument artefact",
    group="instrument",
    parameters=(Parameter("cosine", "um", 1.0), Parameter("sine", "um", 1.0)),
    regressors=_columns,
    law=Law(0.0, 0.0, "even"),
    meaning="A dirty cup, a loose joint or a ball out of round.",
    formula="a cos(3t) + b sin(3t)",
    looks_like=("Three lobes that do not depend on the radius and change when the bar is seated anew."),
    separate_by="Seat the bar again between repeats: it changes, straightness stays.",
    remedy="Clean balls and cups, seat the bar again.",
    reference="Renishaw ballbar help text, tri-lobe test error",
    per="machine",
    confusables=("straightness",),
)
