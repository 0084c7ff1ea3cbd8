"""A lake of small ball-bar campaigns of several machines, each with one fault of its own size."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dtwin.config import Home
from dtwin.lake.store import Lake
from dtwin.schema import Campaign, Run, RunMeta


def fill(
    home: Home,
    campaigns: int,
    machines: int = 2,
    seed: int = 0,
    size_um: Callable[[int], float] = lambda number: 2.0 + number,
) -> list[str]:
    """Commit circles of one radius and feed, three each way, with squareness and 0.2 µm of noise."""
    lake, names = Lake(home.lake), []
    for number in range(campaigns):
        rng = np.random.default_rng([seed, number])
        name = f"c{number:02d}"
        start = f"2026-03-{number + 1:02d}T08:00:00+00:00"
        runs = [_run(f"r{k}", k, size_um(number), rng, start) for k in range(6)]
        lake.commit(Campaign(name, f"mill-{number % machines}", "circular", start, {}), runs)
        names.append(name)
    return names


def _run(name: str, number: int, size_um: float, rng: np.random.Generator, start: str) -> Run:
    way = 1.0 if number % 2 == 0 else -1.0
    turn = np.linspace(0.0, 360.0, 1440, endpoint=False)
    deviation = size_um * np.sin(2.0 * np.radians(way * turn)) + rng.normal(0.0, 0.2, turn.size)
    meta = RunMeta(
        name,
        plane="XY",
        direction="CCW" if way > 0 else "CW",
        radius_mm=100.0,
        feed_mm_min=1000.0,
        repeat=number // 2 + 1,
        setup="a",
        sample_rate_hz=40.0,
        started=start,
    )
    return Run(meta, {"t_s": turn / 9.6, "angle_deg": way * turn, "deviation_um": deviation})
