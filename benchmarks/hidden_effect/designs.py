"""Which circles a case measures, in the order of the session."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dtwin.machines.mill_parameters import CircularTest

COOL_DOWN_S = 1800.0


@dataclass(frozen=True)
class Design:
    """A plan of circles: every feed and direction inside every set-up, repeats in blocks.

    ``paired``: each radius has a feed of its own; the second machine only.
    """

    planes: tuple[str, ...] = ("XY",)
    radii_mm: tuple[float, ...] = (50.0, 150.0)
    feeds_mm_min: tuple[float, ...] = (1000.0, 2000.0, 4000.0)
    directions: tuple[str, ...] = ("CCW", "CW")
    repeats: int = 3
    cool_down: bool = True
    heights: bool = False
    paired: bool = False

    def tests(self, rng: np.random.Generator) -> list[CircularTest]:
        """Return the circles; the order is random inside each block of repeats."""
        out: list[CircularTest] = []
        for plane in self.planes:
            for radius in self.radii_mm:
                out += self._of_setup(plane, radius, rng)
        if self.cool_down and len(out) > 3:
            # Once inside each set-up, so that time and temperature part.
            per_setup = len(out) // (len(self.planes) * len(self.radii_mm))
            for first in range(0, len(out), per_setup):
                at = first + int(per_setup * rng.uniform(0.3, 0.7))
                out[at] = replace(out[at], pause_s=COOL_DOWN_S)
        return out

    def _of_setup(self, plane: str, radius: float, rng: np.random.Generator) -> list[CircularTest]:
        out = []
        for repeat in range(1, self.repeats + 1):
            block = [
                CircularTest(
                    plane,
                    way,
                    radius,
                    feed,
                    repeat,
                    f"{plane}{radius:g}",
                    abbe_offset_mm=2.0 * radius - 50.0 if self.heights else None,
                )
                for feed in self.feeds_mm_min
                for way in self.directions
            ]
            out += [block[i] for i in rng.permutation(len(block))]
        return out


FULL = Design()
DESIGNS = {
    "full": FULL,
    "heights": replace(FULL, heights=True),
    "warm_up": replace(FULL, cool_down=False),
    "one_repeat": replace(FULL, repeats=1),
    "two_repeats": replace(FULL, repeats=2),
    "one_circle": Design(radii_mm=(100.0,), feeds_mm_min=(2000.0,), directions=("CCW",)),
    "both_ways": Design(radii_mm=(100.0,), feeds_mm_min=(2000.0,)),
    "one_way": replace(FULL, directions=("CCW",), radii_mm=(100.0,), feeds_mm_min=(2000.0,)),
    "one_radius": replace(FULL, radii_mm=(100.0,)),
    "one_feed": replace(FULL, radii_mm=(50.0, 100.0, 150.0), feeds_mm_min=(2000.0,)),
    "paired": replace(FULL, radii_mm=(50.0, 100.0, 150.0), paired=True),
    "three_planes": replace(FULL, planes=("XY", "YZ", "ZX"), feeds_mm_min=(1000.0, 4000.0)),
}
