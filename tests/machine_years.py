"""Circular tests of a mill over months, as a ball bar would record them: formulas of their own, no code of dtwin."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

FIRST_DAY = datetime(2025, 1, 6, 8, tzinfo=UTC)


def write_tests(
    folder: Path,
    tests: int,
    backlash_um: Callable[[int], float],
    squareness_um: Callable[[int], float],
    *,
    every_days: int = 30,
    serial: Callable[[int], str] = lambda test: "B1",
    seed: int = 0,
    machine: str = "mill-7",
    first: int = 0,
    named: str = "t",
) -> list[Path]:
    """Write campaign folders, one for each test, each of two circles either way.

    Args:
        backlash_um, squareness_um: Of the number of the test: steps of X after its reversals, and amplitude of the
            ellipse at 45 degrees.
        serial: Serial number of the ball bar.
        first: Number of the first test; ``named``: what stands before the number.
    """
    rng = np.random.default_rng(seed)
    made = []
    for test in range(first, first + tests):
        day = FIRST_DAY + timedelta(days=every_days * test)
        lines = ["[campaign]", f'name = "{named}{test:02d}"', f'machine = "{machine}"', 'kind = "circular"']
        lines += ["[campaign.instrument]", 'model = "bar"', f'serial = "{serial(test)}"']
        place = folder / f"{named}{test:02d}"
        place.mkdir(parents=True)
        set_up = rng.normal(0.0, 0.15, 2)  # Set-up and temperature differ from test to test.
        for repeat in (1, 2):
            for direction, sign in (("CCW", 1), ("CW", -1)):
                name = f"{direction.lower()}{repeat}"
                angle = sign * np.linspace(0.0, 360.0, 721)
                lost = backlash_um(test) + set_up[0]
                error = -0.5 * lost * sign * np.sign(np.sin(np.radians(angle)) + 1e-12) * np.cos(np.radians(angle))
                error += (squareness_um(test) + set_up[1]) * np.sin(2 * np.radians(angle)) + rng.normal(0.0, 0.1, 721)
                period_s = 2 * np.pi * 150.0 / (1000.0 / 60.0) / 720  # 1000 mm/min
                rows = np.column_stack([np.arange(721) * period_s, angle, error])
                np.savetxt(place / f"{name}.csv", rows, "%.4f", ",", header="t_s,angle_deg,deviation_um", comments="")
                lines += ["[[run]]", f'id = "{name}"', f'file = "{name}.csv"', 'plane = "XY"', "radius_mm = 150.0"]
                lines += ["feed_mm_min = 1000.0", f'direction = "{direction}"', f"repeat = {repeat}", 'setup = "a"']
                lines += [f'started = "{(day + timedelta(minutes=repeat)).isoformat()}"']
        (place / "campaign.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
        made.append(place)
    return made


def steady(value: float) -> Callable[[int], float]:
    """Return a size that does not change."""
    return lambda test: value


def wearing(value: float, per_test: float) -> Callable[[int], float]:
    """Return a size that grows."""
    return lambda test: value + per_test * test


def stepping(value: float, at: int, to: float) -> Callable[[int], float]:
    """Return a size that is another one from a test on."""
    return lambda test: to if test >= at else value
