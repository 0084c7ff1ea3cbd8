"""ISO 10791-10 A.3 on paper: sixteen slots, an hour between each, their depth from the error."""

from __future__ import annotations

import numpy as np

from dtwin.errors import InputError
from dtwin.schema import Floats

SLOTS = 16


def slot_places_mm(strokes_mm: dict[str, tuple[float, float]]) -> Floats:
    """Return where the slots are milled: a four by four grid in the lower middle of the volume.

    Returns (16, 3): the grid is ours: the source's drawing cannot be read.
    """
    low = {axis: reach[0] + 0.25 * (reach[1] - reach[0]) for axis, reach in strokes_mm.items()}
    high = {axis: reach[0] + 0.75 * (reach[1] - reach[0]) for axis, reach in strokes_mm.items()}
    grid = [(x, y) for y in np.linspace(low["y"], high["y"], 4) for x in np.linspace(low["x"], high["x"], 4)]
    return np.array([(x, y, low["z"]) for x, y in grid])


def slot_errors_um(depth_um: Floats, start: int) -> Floats:
    """Return the depth error of the slots against the first one.

    ``depth_um``, (hours, 16): error along the tool at every slot's place, hour by hour.
    ``start``: hour of the first slot.
    """
    if not 0 <= start <= len(depth_um) - SLOTS:
        raise InputError(
            "the slots do not fit into the campaign",
            code="volumetric.slots",
            got=f"start {start} h",
            allowed=f"0 to {len(depth_um) - SLOTS} h",
        )
    milled = np.array([depth_um[start + k, k] for k in range(SLOTS)])
    return np.asarray(milled - milled[0])


def slot_ranges_um(depth_um: Floats) -> Floats:
    """Return the range of the slots' errors for every hour at which the test may start."""
    starts = range(len(depth_um) - SLOTS + 1)
    return np.array([np.ptp(slot_errors_um(depth_um, start)) for start in starts])
