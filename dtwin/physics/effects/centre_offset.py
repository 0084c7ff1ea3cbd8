"""The bar turns about a point beside the programmed centre."""

from __future__ import annotations

from dtwin.physics.effect import Effect, Law, Parameter, Shape, stacked
from dtwin.physics.state import State
from dtwin.schema import Floats


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    first, second = state.axes
    return stacked(state.sensitivity[first], state.sensitivity[second])


EFFECT = Effect(
    name="centre_offset",
    title="Centre offset",
    group="instrument",
    parameters=(Parameter("first", "um", 20.0), Parameter("second", "um", 20.0)),
    regressors=_columns,
    law=Law(0.0, 0.0, "even"),
    meaning="The pivot of the instrument is not at the centre of the programmed circle.",
    formula="a cos(t) + b sin(t), and in second order -(a sin(t) - b cos(t))^2 / 2R",
    looks_like="The plot is shifted as a whole, once per turn.",
    separate_by="Mount the instrument again: it changes, errors of the machine do not.",
    remedy="None: it belongs to the set-up and is taken out of every figure.",
    reference="ISO 230-4:2022 annex B, influence of typical machine errors on circular paths",
    per="machine",
    confusables=("thermal_drift", "measurement_delay"),
    setup=True,
)
