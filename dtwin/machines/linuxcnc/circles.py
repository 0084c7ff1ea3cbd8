"""Circles as programs for LinuxCNC, and runs out of what its sampler recorded."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dtwin.errors import DeviceError, InputError
from dtwin.machines.linuxcnc.configuration import AXES, TRAVEL_MM
from dtwin.schema import PLANES, Direction, Floats, Plane

SAMPLE_HZ = 1000.0
# Before and after the turn that counts, so that it has its full speed.
_LEAD_DEG = 45.0
_LARGEST_ACCELERATION_MM_S2 = 800.0
_SELECT = {"XY": "G17", "YZ": "G19", "ZX": "G18"}
_COLUMNS = 13
_APPROACH_MM_MIN = 6000


@dataclass(frozen=True)
class Circle:
    """One pass of the bar.

    ``plane``, ``direction``: plane, and CCW or CW seen against its normal.
    ``radius_mm``, ``feed_mm_min``: length of the bar and programmed speed.
    """

    plane: Plane
    radius_mm: float
    feed_mm_min: float
    direction: Direction

    def __post_init__(self) -> None:
        """Refuse what this machine cannot do at full speed."""
        speed = self.feed_mm_min / 60.0
        largest = 60.0 * math.sqrt(_LARGEST_ACCELERATION_MM_S2 * max(self.radius_mm, 0.0))
        if not 5.0 <= self.radius_mm <= 0.9 * TRAVEL_MM:
            raise InputError(
                "the circle does not fit the machine",
                code="linuxcnc.radius",
                got=f"{self.radius_mm:g} mm",
                allowed=f"5 to {0.9 * TRAVEL_MM:g} mm",
            )
        if not (self.feed_mm_min >= 100.0 and speed * speed / self.radius_mm <= _LARGEST_ACCELERATION_MM_S2):
            raise InputError(
                "the axes cannot hold this feed on this circle",
                code="linuxcnc.feed",
                got=f"{self.feed_mm_min:g} mm/min at {self.radius_mm:g} mm",
                allowed=f"100 to {largest:z.0f} mm/min",
            )


@dataclass(frozen=True)
class Trace:
    """One turn as the controller's sampler saw it, one row per servo cycle.

    ``t_s``, shape (n,): from the first sample of the turn.
    ``command_mm``, ``encoder_mm``, ``offset_mm``, shape (n, 3): programmed path without corrections, encoders, external
    offsets in force.
    ``deviation_um``, shape (n,): of the bar's length.
    """

    circle: Circle
    t_s: Floats
    command_mm: Floats
    encoder_mm: Floats
    offset_mm: Floats
    deviation_um: Floats

    @property
    def angle_deg(self) -> Floats:
        """Angle of the encoders' position, unwrapped, shape (n,)."""
        return _angle_deg(self.encoder_mm, self.circle)


def program(circles: Sequence[Circle]) -> str:
    """Return G-code that runs circles about the machine's zero, in order.

    Every circle tells the HAL what it is through analogue outputs that LinuxCNC sets in step with
    the motion (M67): 0 number, counted from 1; 1 direction; 2 radius; 3 to 5 centre; 6 plane; 7 feed.
    """
    lines = ["G21 G90 G64 G94 G49 G40"]
    for number, circle in enumerate(circles, start=1):
        first, second = (AXES[i] for i in _axes(circle.plane))
        sign = 1.0 if circle.direction == "CCW" else -1.0
        end = math.radians(2.0 * _LEAD_DEG)
        told = {
            1: sign,
            2: circle.radius_mm,
            3: 0.0,
            4: 0.0,
            5: 0.0,
            6: float(PLANES.index(circle.plane)),
            7: circle.feed_mm_min,
            0: float(number),
        }
        at = (circle.radius_mm * math.cos(end), sign * circle.radius_mm * math.sin(end))
        centre = f"{'IJK'[AXES.index(first)]}{-circle.radius_mm:z.6f}"
        others = "".join(f" {a}0" for a in AXES if a not in (first, second))
        lines += [
            f"(circle {number}: {circle.plane} R{circle.radius_mm:g} {circle.direction})",
            f"{_SELECT[circle.plane]} G1 F{_APPROACH_MM_MIN}{others}",
            f"G1 {first}{circle.radius_mm:z.6f} {second}0",
            "G4 P0.2",
            *(f"M67 E{pin} Q{value:z.6f}" for pin, value in told.items()),
            f"{'G3' if sign > 0 else 'G2'} {first}{at[0]:z.6f} {second}{at[1]:z.6f} {centre} "
            f"{'IJK'[AXES.index(second)]}0 P2 F{circle.feed_mm_min:g}",
            "M67 E0 Q0",
            "M67 E2 Q0",
        ]
    return "\n".join([*lines, f"G1 F{_APPROACH_MM_MIN} X0 Y0 Z0", "M2", ""])


def read_samples(path: Path) -> Floats:
    """Return the recording of ``halsampler -t``, shape (n, 13): number, then the pins.

    Raises ``DeviceError`` when it is empty, broken, or samples are missing.
    """
    rows: list[list[bytes]] = []
    whole = True
    with path.open("rb") as file:
        for line in file:
            row = line.split()
            if row == [b"overrun"]:
                # What went missing before the first circle does not matter.
                whole = not any(float(r[1]) > 0.0 for r in rows)
                rows = [] if whole else rows
            elif line.endswith(b"\n"):
                rows.append(row)
            if not whole:
                break
    if not whole or any(len(row) != _COLUMNS for row in rows) or len(rows) < 2:
        raise DeviceError(
            "the sampler's recording is not whole",
            code="linuxcnc.samples",
            where=path.name,
            got=f"{len(rows)} rows" if whole else "an overrun during a circle",
            hint="the computer was too busy to fetch the samples; measure again",
        )
    samples = np.array(rows, dtype=float)
    gaps = np.flatnonzero(np.diff(samples[:, 0]) != 1.0)
    if len(gaps):
        raise DeviceError(
            "samples are missing in the controller's recording",
            code="linuxcnc.samples",
            where=path.name,
            got=f"{len(gaps)} gaps, the first after {samples[gaps[0], 0]:z.0f}",
            hint="the computer was too busy to fetch them; measure again",
        )
    return samples


def traces(samples: Floats, circles: Sequence[Circle]) -> list[Trace]:
    """Cut one whole turn at programmed speed out of every circle.

    ``samples``, shape (n, 13): from ``read_samples``.
    Raises ``DeviceError`` when a circle is not there as a whole.
    """
    return [_trace(samples, number, c) for number, c in enumerate(circles, start=1)]


def _trace(samples: Floats, number: int, circle: Circle) -> Trace:
    rows = samples[samples[:, 1] == number]
    command = rows[:, 2:5] - rows[:, 9:12]
    moving = rows[:, 12] > 0.0
    angle = _angle_deg(command, circle) if len(rows) > 1 else np.zeros(0)
    turned = np.abs(angle - angle[0]) if len(angle) else angle
    chosen = np.flatnonzero(moving & (turned >= _LEAD_DEG) & (turned < _LEAD_DEG + 360.0))
    if not len(chosen) or turned.max() < _LEAD_DEG + 360.0 or np.diff(chosen).max() != 1:
        raise DeviceError(
            "a circle was not run as a whole",
            code="linuxcnc.circle",
            where=f"circle {number}",
            got=f"{turned.max() if len(turned) else 0.0:z.0f} deg in {len(rows)} samples",
        )
    cut = rows[chosen]
    return Trace(circle, (cut[:, 0] - cut[0, 0]) / SAMPLE_HZ, command[chosen], cut[:, 5:8], cut[:, 9:12], cut[:, 8])


def _angle_deg(position_mm: Floats, circle: Circle) -> Floats:
    first, second = _axes(circle.plane)
    angle = np.unwrap(np.arctan2(position_mm[:, second], position_mm[:, first]))
    return np.asarray(np.degrees(angle))


def _axes(plane: Plane) -> tuple[int, int]:
    number = PLANES.index(plane)
    return number, (number + 1) % 3
