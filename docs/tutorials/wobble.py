"""A wobble with five waves per turn that grows with the feed."""

import numpy as np

from dtwin.physics.effect import Effect, Law, Parameter, Shape
from dtwin.physics.state import State


def columns(state: State, axis: str, shape: Shape) -> np.ndarray:
    """Return um of error per um of amplitude at 50 mm/s: cosine and sine."""
    grown = state.feed_mm_s / 50.0
    phase = 5.0 * state.angle_rad
    return grown * np.stack([np.cos(phase), np.sin(phase)], axis=1)


EFFECT = Effect(
    name="wobble",
    title="Wobble of the rotary table",
    parameters=(Parameter("cosine", "um", 1.0), Parameter("sine", "um", 1.0)),
    regressors=columns,
    law=Law(feed=1.0, radius=0.0, direction="even"),
    per="machine",
    meaning="Five magnets of the table motor pull once each per turn, harder at speed.",
    formula="(F / 50 mm/s) (a cos(5t) + b sin(5t))",
    looks_like="Five waves per turn, larger at higher feed.",
    separate_by="Change the feed: it grows in proportion.",
    remedy="Ask the maker of the table for a cogging table.",
    reference="Our own shop, March.",
)
