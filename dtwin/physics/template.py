"""An effect file to start from."""

from __future__ import annotations

from dtwin.schema import require_name

_TEMPLATE = '''"""Say in one line what this effect is."""

import numpy as np

from dtwin.physics.effect import Effect, Law, Parameter
from dtwin.physics.state import State


def columns(state: State, axis: str, shape: dict) -> np.ndarray:
    """Return µm of error for one unit of the parameter, one row for each point.

    state.position_mm["X"], state.velocity_mm_s["X"], state.acceleration_mm_s2["X"]: motion
    state.sensitivity["X"]: how much an error along X changes the measured length
    state.angle_rad, state.radius_mm, state.feed_mm_s, state.direction: the circle
    state.column("temperature_c"): what was logged (name it in needs)
    """
    return np.cos(4.0 * state.angle_rad)[:, None]


EFFECT = Effect(
    name="NAME",
    title="A name in words",
    parameters=(Parameter("amplitude", "um", 1.0),),
    regressors=columns,
    law=Law(feed=0.0, radius=0.0, direction="even"),
    per="machine",
    meaning="What happens in the machine.",
    formula="a cos(4t)",
    looks_like="What the plot shows.",
    separate_by="Which run tells it from what it resembles.",
    remedy="What to do about it.",
    reference="Where it is described.",
)
'''


def template(name: str) -> str:
    """Return an effect file."""
    return _TEMPLATE.replace("NAME", require_name(name, "the effect"))
