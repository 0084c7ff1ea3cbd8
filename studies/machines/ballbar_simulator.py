"""The published ball-bar simulator: errors of two linear axes added up as formulas.

Machines of Xing, Bonev, Champliaud and Liu, Meas. Sci. Technol. 35 (2024) 085601, tables A and B.
The commercial simulator's own formulas, signs and phases are not printed; these are the usual
ones, with the signs as settings.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtwin.schema import Floats

_ABSENT: dict[str, Any] = {
    "cyclic_x": [0.0, 0.0],
    "cyclic_y": [0.0, 0.0],
    "pitch_x": 10.0,
    "pitch_y": 10.0,
    "lateral_play_x": [0.0, 0.0],
    "lateral_play_y": [0.0, 0.0],
    "servo_mismatch": 0.0,
    "reversal_spike_x": [0.0, 0.0],
    "reversal_spike_y": [0.0, 0.0],
}
UM_PER_PPM_MM = 1e-3


@dataclass(frozen=True)
class Convention:
    """What the paper leaves open.

    ``squareness``, ``straightness``, ``backlash``, ``lateral_play``, ``servo_mismatch``, ``spike``: signs. Of the 64
    choices the default one is the one that comes nearest to the printed circular deviations of machines 2 and 3 with
    the directions as printed.
    ``cyclic_rad``: phases of the cyclic errors of X and Y.
    ``spike_deg``: path angle in which a reversal spike falls to 1/e.
    """

    squareness: int = -1
    straightness: int = -1
    backlash: int = -1
    lateral_play: int = -1
    servo_mismatch: int = 1
    spike: int = -1
    cyclic_rad: tuple[float, float] = (0.0, 0.0)
    spike_deg: float = 3.0


def radial_error_um(
    machine: Mapping[str, Any],
    feed_mm_min: float,
    direction: int,
    theta_rad: Floats,
    convention: Convention | None = None,
) -> Floats:
    """Return the radial error of a simulated machine, shape of ``theta_rad``.

    ``machine``: a table of ``ballbar_simulator.toml``: radius mm, scale ppm, squareness um/m, lengths um, pitch mm,
    servo mismatch ms; two values are the positive and the negative end of an axis.
    ``feed_mm_min``: feed.
    ``direction``, 1 or -1: counter-clockwise or clockwise.
    ``theta_rad``: angles.
    ``convention``: signs, phases, width of spikes.
    """
    machine, made = _ABSENT | dict(machine), convention or Convention()
    cos, sin = np.cos(theta_rad), np.sin(theta_rad)
    x, y = machine["radius"] * cos, machine["radius"] * sin
    right, up = -direction * sin > 0.0, direction * cos > 0.0
    going_x, going_y = np.where(right, 1.0, -1.0), np.where(up, 1.0, -1.0)
    square = made.squareness * machine["squareness"]
    ex = UM_PER_PPM_MM * (x * machine["scale_x"] - y * square)
    ey = UM_PER_PPM_MM * y * machine["scale_y"]
    ey += made.straightness * machine["straightness_x"] * cos**2
    ex += made.straightness * machine["straightness_y"] * sin**2
    ex -= made.backlash * going_x * _between(machine["backlash_x"], cos) / 2
    ey -= made.backlash * going_y * _between(machine["backlash_y"], sin) / 2
    ey += made.lateral_play * going_x * _between(machine["lateral_play_x"], cos) / 2
    ex += made.lateral_play * going_y * _between(machine["lateral_play_y"], sin) / 2
    ex += _cyclic(machine["cyclic_x"], machine["pitch_x"], x, right, made.cyclic_rad[0])
    ey += _cyclic(machine["cyclic_y"], machine["pitch_y"], y, up, made.cyclic_rad[1])
    width = np.radians(made.spike_deg)
    ex += made.spike * _spike(machine["reversal_spike_x"], direction * theta_rad, width)
    turned = direction * (theta_rad - np.pi / 2)
    ey += made.spike * _spike(machine["reversal_spike_y"], turned, width)
    lag = made.servo_mismatch * direction * machine["servo_mismatch"] * feed_mm_min / 60.0
    return np.asarray(ex * cos + ey * sin + lag * np.sin(2 * theta_rad) / 2)


def vibration_um(peak_to_peak_um: float, samples: int, rng: np.random.Generator) -> Floats:
    """Return vibration of a given peak-to-peak height: white and uniform, the paper says no more.

    ``peak_to_peak_um``: height.
    ``samples``: how many.
    ``rng``: source of randomness.
    """
    return peak_to_peak_um * (rng.random(samples) - 0.5)


def _between(ends: list[float], place: Floats) -> Floats:
    """From the negative end at -1 to the positive one at +1."""
    return ends[0] * (1 + place) / 2 + ends[1] * (1 - place) / 2


def _cyclic(height: list[float], pitch_mm: float, at_mm: Floats, forwards: NDArray[np.bool_], phase: float) -> Floats:
    wave = np.sin(2 * np.pi * at_mm / pitch_mm + phase)
    return np.where(forwards, height[0], height[1]) / 2 * wave


def _spike(ends: list[float], travelled_rad: Floats, width_rad: float) -> Floats:
    """An outward push after each reversal of an axis, dying out along the path."""
    decay = np.exp(-(travelled_rad % np.pi) / width_rad)
    return np.where(travelled_rad % (2 * np.pi) < np.pi, ends[0], -np.array(ends[1])) * decay
