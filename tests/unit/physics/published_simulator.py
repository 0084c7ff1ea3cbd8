"""The published ball-bar simulator's definitions, written out anew: shares no code with the fit.

Xing, Bonev, Champliaud, Liu, Meas. Sci. Technol. 35 (2024) 085601, tables A and B. The width of a
reversal spike is not published; here it decays in time.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from dtwin.schema import Direction, Floats, Run, RunMeta

SPIKE_MS = 60.0
ABSENT = {
    "cyclic_x": [0.0, 0.0], "cyclic_y": [0.0, 0.0], "pitch_x": 10.0, "pitch_y": 10.0,
    "lateral_play_x": [0.0, 0.0], "lateral_play_y": [0.0, 0.0], "servo_mismatch": 0.0,
    "reversal_spike_x": [0.0, 0.0], "reversal_spike_y": [0.0, 0.0],
}  # fmt: skip


def trace_um(machine: dict[str, Any], feed_mm_min: float, direction: int, theta: Floats) -> Floats:
    """Radial error at path angles, by adding up what each axis does."""
    machine = ABSENT | machine
    radius = float(machine["radius"])
    speed = feed_mm_min / 60.0
    out = np.empty(len(theta))
    for i, t in enumerate(theta):
        x, y = radius * math.cos(t), radius * math.sin(t)
        going_x = -direction * math.sin(t)
        going_y = direction * math.cos(t)
        right = (1 + math.cos(t)) / 2
        up = (1 + math.sin(t)) / 2
        ex = ey = 0.0
        ex += x * machine["scale_x"] / 1000 - y * machine["squareness"] / 1000
        ey += y * machine["scale_y"] / 1000
        ey += machine["straightness_x"] * math.cos(t) ** 2
        ex += machine["straightness_y"] * math.sin(t) ** 2
        sx = 1.0 if going_x > 0 else -1.0
        sy = 1.0 if going_y > 0 else -1.0
        ex -= sx * blend(machine["backlash_x"], right) / 2
        ey -= sy * blend(machine["backlash_y"], up) / 2
        ey += sx * blend(machine["lateral_play_x"], right) / 2
        ex += sy * blend(machine["lateral_play_y"], up) / 2
        cx = machine["cyclic_x"][0 if going_x > 0 else 1]
        cy = machine["cyclic_y"][0 if going_y > 0 else 1]
        ex += cx / 2 * math.sin(2 * math.pi * x / machine["pitch_x"] + 0.4)
        ey += cy / 2 * math.sin(2 * math.pi * y / machine["pitch_y"] + 1.1)
        ex += spike(machine["reversal_spike_x"], t, direction, radius / speed)
        ey += spike(machine["reversal_spike_y"], t - math.pi / 2, direction, radius / speed)
        along = ex * math.cos(t) + ey * math.sin(t)
        out[i] = along + direction * machine["servo_mismatch"] * speed * math.sin(2 * t) / 2
    return out


def blend(ends: list[float], share: float) -> float:
    return ends[0] * share + ends[1] * (1 - share)


def spike(ends: list[float], angle: float, direction: int, seconds_per_rad: float) -> float:
    """An outward push after each reversal of the axis, dying out in time."""
    since = (direction * angle) % math.pi
    positive = (direction * angle) % (2 * math.pi) < math.pi
    decay = math.exp(-since * seconds_per_rad * 1000 / SPIKE_MS)
    return ends[0] * decay if positive else -ends[1] * decay


def measured(
    machine: dict[str, Any],
    feeds: tuple[float, ...],
    *,
    noise_um: float = 0.1,
    repeats: int = 3,
    seed: int = 1,
) -> list[Run]:
    """Runs of the simulated machine: both directions, with a centre offset and noise."""
    rng = np.random.default_rng(seed)
    radius = float(machine["radius"])
    runs = []
    for repeat in range(1, repeats + 1):
        for feed in feeds:
            for sign, name in ((1, "CCW"), (-1, "CW")):
                way: Direction = "CCW" if name == "CCW" else "CW"
                angle = np.arange(0.0, 360.0, 0.1) + rng.uniform(0, 0.1)
                angle = angle if sign > 0 else 360.0 - angle
                theta = np.radians(angle)
                clean = trace_um(machine, feed, sign, theta)
                # A bar about a centre that is 3 um right of and 2 um below the programmed one.
                bar = np.hypot(
                    (radius * 1000 + clean) * np.cos(theta) + 3.0,
                    (radius * 1000 + clean) * np.sin(theta) - 2.0,
                )
                seconds = 2 * np.pi * radius / (feed / 60.0)
                runs.append(
                    Run(
                        RunMeta(
                            f"r{len(runs)}", plane="XY", direction=way, radius_mm=radius,
                            feed_mm_min=feed, repeat=repeat,
                        ),
                        {
                            "t_s": np.linspace(0.0, seconds, len(angle)),
                            "angle_deg": angle,
                            "deviation_um": bar - radius * 1000
                            + noise_um * rng.standard_normal(len(angle)),
                        },
                    )
                )  # fmt: skip
    return runs
