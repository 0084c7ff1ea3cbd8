"""What changes between two groups on the Z slide: the room, and with it oil and structure."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dtwin.machines._wandering import wandering
from dtwin.machines.turning import Slide
from dtwin.schema import Floats


@dataclass(frozen=True)
class RoomDrift:
    """A room whose temperature wanders, and a slide that follows it.

    ``room_c``: standard deviation of the room's temperature about its mean.
    ``oil_per_c``: share of the servo's damping that a warmer, thinner guideway oil takes away.
    ``softening_per_c``: share of its stiffness that the warmer structure loses.
    """

    room_c: float = 0.8
    time_constant_s: float = 1800.0
    oil_per_c: float = 0.03
    softening_per_c: float = 0.002

    def rises_c(self, t_s: Floats, seed: int) -> Floats:
        """Return the room's temperature over its mean at ascending times, shape (n,)."""
        rng = np.random.default_rng([seed, 31])
        return self.room_c * wandering(rng, t_s, self.time_constant_s)

    def slide_at(self, slide: Slide, rise_c: float) -> Slide:
        """Return the slide in a room that is warmer by ``rise_c``."""
        return replace(
            slide,
            servo_damping=slide.servo_damping * (1.0 - self.oil_per_c * rise_c),
            structure_hz=slide.structure_hz * (1.0 - self.softening_per_c * rise_c) ** 0.5,
        )
