"""Length and angle are not taken at the same moment."""

from __future__ import annotations

from dtwin.physics.effect import Effect, Law, Parameter, Shape, stacked
from dtwin.physics.state import State
from dtwin.schema import Floats


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    rate = state.direction * state.feed_mm_s / state.radius_mm
    first, second = state.axes
    return stacked(rate * state.sensitivity[first], rate * state.sensitivity[second])


EFFECT = Effect(
    name="measurement_delay",
    title="Measurement delay",
    parameters=(
        Parameter("first", "um s", 1.0),
        Parameter("second", "um s", 1.0),
    ),
    regressors=_columns,
    law=Law(1.0, -1.0, "odd"),
    meaning=(
        "The reading of the bar is late against the angle: the centre offset seems to turn "
        "with the speed."
    ),
    formula="d (F / R) (a cos(t) + b sin(t))",
    looks_like="The centre differs between the directions, in proportion to the angular speed.",
    separate_by="Halve the feed: the difference of the centres halves.",
    remedy="Trigger both from one clock; correct the delay.",
    reference="[D] time shift of a shifted circle",
    per="machine",
    confusables=(
        "centre_offset",
        "backlash",
    ),
)
