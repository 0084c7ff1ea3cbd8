"""Runs of the published simulated machines; the generator shares no code with the fit.

The width of a reversal spike is not published; here it decays in time.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from dtwin.schema import Direction, Run, RunMeta
from studies.machines.ballbar_simulator import Convention, radial_error_um

SPIKE_MS = 60.0


def convention(feed_mm_min: float, radius_mm: float) -> Convention:
    """The signs of dtwin's own effects."""
    spike_rad = 1e-3 * SPIKE_MS * feed_mm_min / 60.0 / radius_mm
    return Convention(1, 1, 1, 1, 1, 1, (0.4, 1.1), float(np.degrees(spike_rad)))


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
                clean = radial_error_um(machine, feed, sign, theta, convention(feed, radius))
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
