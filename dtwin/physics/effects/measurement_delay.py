"""Length and angle are not taken at the same moment."""

from __future__ import annotations

from dtwin.physics.effect import Effect, Law, Parameter, Shape
from dtwin.physics.state import State
from dtwin.schema import Floats


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    rate_rad_s = state.direction * state.feed_mm_s / state.radius_mm
    first, second = state.axes
    across = state.column("setup_first_um") * state.sensitivity[second]
    across = across - state.column("setup_second_um") * state.sensitivity[first]
    return (1e-3 * rate_rad_s * across)[:, None]


EFFECT = Effect(
    name="measurement_delay",
    title="Measurement delay",
    group="instrument",
    parameters=(Parameter("delay", "ms", 1.0),),
    regressors=_columns,
    law=Law(1.0, None, "odd"),
    meaning=(
        "The reading is late against the angle that was asked for: the bar or its trigger is, or all axes follow their set "
        "points by the same time, as a servo lag does. The centre offset seems to turn with the speed."
    ),
    formula="d (F / R) tau (a sin(t) - b cos(t)), a and b the centre of the set-up",
    looks_like="The centre differs between the directions, in proportion to the angular speed.",
    separate_by="Halve the feed: the difference of the centres halves.",
    remedy="Beside a servo lag of the same time it is that lag. Else trigger both from one clock; correct the delay.",
    reference="[D] time shift of a shifted circle",
    per="machine",
    needs=("setup_first_um", "setup_second_um"),
    confusables=("centre_offset", "backlash", "servo_lag"),
)
