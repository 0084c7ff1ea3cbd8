"""From five probe readings to where a block lies, and the rules by which a placement counts.

The rules are fixed before anything is measured: a set-up that slipped and a search that ran to its
end are left out of every figure and counted, never replaced by a number.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dtwin.errors import InputError
from dtwin.schema import Floats

COUNTS, SETUP_SLIP, TRAVEL_LIMIT, NOT_SQUARE = "ok", "setup_slip", "travel_limit", "not_square"
FLAGS = (COUNTS, SETUP_SLIP, TRAVEL_LIMIT, NOT_SQUARE)
JIG_MOVED_LIMIT_UM = 30.0
FACES_LIMIT_DEG = 0.1
_AT_END_MM = 0.002


@dataclass(frozen=True)
class ProbeSettings:
    """What the evaluation must know of block and probe.

    ``half_x_mm``, ``half_y_mm``, ``thickness_mm``: block at ``reference_c``.
    ``ball_radius_mm``: effective radius of the probe's ball.
    ``search_mm``: how far each search reaches from the expected face.
    ``expansion_1_k``, ``reference_c``: thermal growth of the block.
    ``x_at_y_mm``, ``y_at_x_mm``: where the two X faces' and Y faces' touches are made.
    """

    half_x_mm: float
    half_y_mm: float
    thickness_mm: float
    ball_radius_mm: float
    search_mm: float
    expansion_1_k: float
    reference_c: float
    x_at_y_mm: tuple[float, float]
    y_at_x_mm: tuple[float, float]


@dataclass(frozen=True)
class Placed:
    """Where a block lies.

    ``error_um``, (3,): centre of its lower face, relative to where it should be.
    ``turned_deg``: about the vertical, both faces together.
    ``faces_disagree_deg``: rotation by the X face minus rotation by the Y face.
    ``flag``: one of ``FLAGS``.
    """

    error_um: Floats
    turned_deg: float
    faces_disagree_deg: float
    flag: str


def locate(readings_mm: Floats, temperature_c: float, jig_moved_um: float, settings: ProbeSettings) -> Placed:
    """Find a block from five readings of the ball's centre: X, X, Y, Y, Z.

    The two touches on each face give its direction; the ball's radius and half of the block, as
    large as it is at its temperature, are taken off along the face's normal, not along an axis.

    ``readings_mm``, (5,): centre of the ball along the direction of search, relative to the expected block.
    ``temperature_c``: of the block.
    ``jig_moved_um``: by how much the jig's pin, probed after the placement, has moved.
    ``settings``: block and probe.
    Raises ``InputError`` when there are not five finite readings.
    """
    readings = np.asarray(readings_mm, dtype=float)
    if readings.shape != (5,) or not np.isfinite(readings).all():
        raise InputError(
            "a placement needs five finite probe readings",
            code="placement.readings",
            got=str(readings_mm)[:120],
            allowed="x1, x2, y1, y2, z in mm",
        )
    s = settings
    (x1, x2), (y1, y2), z = readings[:2], readings[2:4], float(readings[4])
    reach_x, reach_y = s.x_at_y_mm[1] - s.x_at_y_mm[0], s.y_at_x_mm[1] - s.y_at_x_mm[0]
    by_x = -float(np.arctan2(x2 - x1, reach_x))
    by_y = float(np.arctan((y2 - y1) / reach_y))
    turned = (reach_x**2 * by_x + reach_y**2 * by_y) / (reach_x**2 + reach_y**2)
    across = np.array([np.cos(turned), np.sin(turned)])
    along = np.array([-np.sin(turned), np.cos(turned)])
    grown = 1.0 + s.expansion_1_k * (temperature_c - s.reference_c)
    on_x = np.column_stack([[x1, x2], s.x_at_y_mm]) @ across
    on_y = np.column_stack([s.y_at_x_mm, [y1, y2]]) @ along
    to_x = float(on_x.mean()) - s.half_x_mm * grown - s.ball_radius_mm
    to_y = float(on_y.mean()) - s.half_y_mm * grown - s.ball_radius_mm
    centre = to_x * across + to_y * along
    height = z - s.thickness_mm * grown - s.ball_radius_mm
    faces = float(np.degrees(by_x - by_y))
    flag = _flag(readings, faces, jig_moved_um, settings)
    error = 1e3 * np.array([centre[0], centre[1], height])
    return Placed(error, float(np.degrees(turned)), faces, flag)


def _flag(readings: Floats, faces_deg: float, jig_um: float, s: ProbeSettings) -> str:
    expected = np.array([s.half_x_mm] * 2 + [s.half_y_mm] * 2 + [s.thickness_mm]) + s.ball_radius_mm
    if np.any(np.abs(readings - expected) > s.search_mm - _AT_END_MM):
        return TRAVEL_LIMIT
    if abs(jig_um) > JIG_MOVED_LIMIT_UM:
        return SETUP_SLIP
    return NOT_SQUARE if abs(faces_deg) > FACES_LIMIT_DEG else COUNTS
