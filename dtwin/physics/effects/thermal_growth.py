"""Axes grow with temperature."""

from __future__ import annotations

import numpy as np

from dtwin.physics.effect import Effect, Law, Parameter, Shape
from dtwin.physics.state import State
from dtwin.schema import Floats


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    rise = state.column("temperature_rise_c")
    axes = [axis] if axis else list(state.axes)
    grown = sum((state.position_mm[a] * state.sensitivity[a] for a in axes if a in state.axes), start=np.zeros(state.n))
    return (1e-3 * rise * grown)[:, None]


EFFECT = Effect(
    name="thermal_growth",
    cause="thermal_growth",
    title="Thermal growth",
    group="heat",
    parameters=(Parameter("expansion", "um/(m K)", 10.0),),
    regressors=_columns,
    law=Law(0.0, 1.0, "even"),
    meaning=("Scales, screws or the workpiece side grow with temperature: all axes alike, or one axis."),
    formula="a dT R, for one axis a dT R cos^2(t)",
    looks_like="The circle grows or becomes oval as the machine warms up.",
    separate_by=(
        "Let the machine cool down in the middle of the campaign: growth turns back with "
        "temperature, wear and drift do not. A second radius tells it from a shift of the "
        "set-up."
    ),
    remedy="Warm up before measuring, cool the screw, scale with temperature compensation.",
    reference="ISO 230-3; ISO 1",
    per="machine_and_axis",
    needs=("temperature_c",),
    kinds=("circular", "linear"),
    confusables=("thermal_drift", "scale_mismatch", "radius_offset"),
    correctable="A scale factor that follows the logged temperature.",
    within_condition=True,
)
