"""One turn of a circle at equal steps of the angle, as filters and distances want it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dtwin.errors import InputError
from dtwin.schema import Floats

MOST_READINGS = 1000
"""Quadratic distances are not computed on more readings per revolution than this."""

_TURN_DEG = 360.0
# A gap of more than this, and an interpolated reading would be invented.
_LARGEST_GAP_DEG = 5.0


@dataclass(frozen=True)
class Turn:
    """One revolution in the order of travel, readings at equal steps of the angle.

    Attributes:
        angle_deg: Angle in the plane; rises for CCW, falls for CW; steps of ``360 / n``. Shape (n,).
        deviation_um: Measured minus nominal radius. Shape (n,).
    """

    angle_deg: Floats
    deviation_um: Floats

    @property
    def readings(self) -> int:
        """Readings per revolution."""
        return len(self.angle_deg)


def one_turn(angle_deg: Floats, deviation_um: Floats, readings: int) -> Turn:
    """Return the first whole revolution, interpolated linearly at equal steps of the angle.

    Interpolated, not averaged over steps: an average would take vibration away, and more of it
    from a slow run, which has more readings per step.

    Args:
        angle_deg: Unwrapped angle of every sample, rising or falling. Shape (m,).
        deviation_um: Measured minus nominal radius. Shape (m,).
        readings: Readings per revolution that are wanted.

    Raises:
        InputError: When the samples do not go once round, have gaps, turn back, or are not finite.
    """
    angle = np.asarray(angle_deg, dtype=float)
    deviation = np.asarray(deviation_um, dtype=float)
    if readings < 8 or len(angle) != len(deviation) or len(angle) < 8:
        raise InputError(
            "a turn needs at least 8 readings with their angles",
            code="dynamics.readings",
            got=f"{len(angle)} angles, {len(deviation)} deviations, {readings} wanted",
        )
    if not (np.isfinite(angle).all() and np.isfinite(deviation).all()):
        raise InputError("a reading is not a finite number", code="dynamics.not_finite")
    travelled = np.abs(angle - angle[0])
    step = np.diff(travelled)
    if (step <= 0.0).any():
        raise InputError(
            "the angle stands still or turns back",
            code="dynamics.angle",
            where=f"sample {int(np.argmax(step <= 0.0)) + 1}",
            hint="dtwin check names what is wrong with the angles",
        )
    # The last sample of a whole turn is up to two steps before the first one comes round again.
    covered = float(travelled[-1] + 2.0 * np.median(step))
    if covered < _TURN_DEG or step.max() > _LARGEST_GAP_DEG:
        raise InputError(
            "the samples do not go once round without a gap",
            code="dynamics.arc",
            got=f"{covered:z.2f} deg, largest gap {step.max():z.2f} deg",
            allowed=f"360 deg and more, gaps up to {_LARGEST_GAP_DEG:g} deg",
        )
    wanted = np.arange(readings) * (_TURN_DEG / readings)
    sign = 1.0 if angle[-1] > angle[0] else -1.0
    if travelled[-1] < _TURN_DEG:
        travelled = np.append(travelled, _TURN_DEG)
        deviation = np.append(deviation, deviation[0])
    return Turn(angle[0] + sign * wanted, np.interp(wanted, travelled, deviation))
