"""What turns with a lead screw, as waves of its pitch."""

from __future__ import annotations

import numpy as np

from dtwin.physics.effect import moves, stacked
from dtwin.physics.state import State
from dtwin.schema import Floats

ORDERS = 4
_GRAIN = 360
# Of each order: angles that show it, places that tell it from chance.
_ANGLES, _PLACES = 3, 6
PITCH = "screw_pitch_mm"


def screw_waves(state: State, axis: str) -> Floats:
    """Return cosine and sine of the first orders of a turn, where the pitch is known.

    ``state``: ``geometry`` holds ``screw_pitch_mm``.
    Returns (n, 2 * ORDERS): zero where the axis stands, the pitch is not stated, the points of the path meet the
    screw at too few angles to show an order, or are so few that a screw of so many orders would meet any error there.
    """
    pitch_mm = state.geometry.get(PITCH)
    if not moves(state, axis) or not isinstance(pitch_mm, int | float) or pitch_mm <= 0.0:
        return np.zeros((state.n, 2 * ORDERS))
    position_mm = state.position_mm[axis]
    turn = 2.0 * np.pi * position_mm / pitch_mm
    places_mm = np.unique(position_mm)
    most = min(_angles(places_mm, pitch_mm) / _ANGLES, len(places_mm) / _PLACES)
    waves = [
        wave(order * turn) * state.sensitivity[axis] if order < most else np.zeros(state.n)
        for order in range(1, ORDERS + 1)
        for wave in (np.cos, np.sin)
    ]
    return stacked(*waves)


def _angles(position_mm: Floats, pitch_mm: float) -> int:
    """Return at how many angles points of a path meet the screw."""
    return len(np.unique(np.round(_GRAIN * (position_mm / pitch_mm % 1.0)) % _GRAIN))
