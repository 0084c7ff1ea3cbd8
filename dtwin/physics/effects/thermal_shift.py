"""The zero of a positioning test moves with temperature."""

from __future__ import annotations

from dtwin.physics.effect import Effect, Law, Parameter, Shape
from dtwin.physics.state import State
from dtwin.schema import Floats


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    return state.column("temperature_rise_c")[:, None]


EFFECT = Effect(
    name="thermal_shift",
    title="Thermal shift of the zero",
    group="heat",
    parameters=(Parameter("shift", "um/K", 2.0),),
    regressors=_columns,
    law=Law(0.0, 0.0, "even"),
    meaning=(
        "What lies between the instrument and the place where the axis is held grows with temperature: "
        "a screw that is held at its end moves the middle of the travel, too."
    ),
    formula="b dT, the same all along the axis",
    looks_like="Whole curves move up and down from run to run, as the temperature does.",
    separate_by=(
        "Let the machine cool down in the middle of the campaign: a shift turns back with temperature, drift does not."
    ),
    remedy="Warm up before measuring; hold the screw near the zero; a scale instead of the screw.",
    reference="ISO 230-3",
    per="machine",
    needs=("temperature_c",),
    kinds=("linear",),
    confusables=("thermal_drift", "thermal_growth"),
    correctable="An offset that follows the logged temperature.",
    within_condition=True,
)
