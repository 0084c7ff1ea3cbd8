"""The virtual hexapod cell as a bench, and the published feed sweep as its plan."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime, timedelta
from typing import Any

from dtwin.machines.hexapod import VirtualHexapod
from dtwin.machines.hexapod_parameters import CENTRE_MM
from dtwin.machines.motion import CircleCondition
from dtwin.plan import Plan, PlannedTest, expand
from dtwin.schema import Direction, Run, RunMeta

FEEDS_MM_MIN = (300.0, 600.0, 1200.0, 1800.0, 2400.0, 3000.0, 3600.0, 4800.0, 6000.0)
QUICK_FEEDS_MM_MIN = (1200.0, 3000.0, 6000.0)
RADIUS_MM, _REPEATS = 50.0, 2
_EPOCH = datetime(2026, 3, 2, 9, 0, tzinfo=UTC)
_BETWEEN = timedelta(minutes=5)


def feed_sweep(*, quick: bool = False) -> Plan:
    """Return the published sweep: YZ, 50 mm, nine feeds, twice, both directions. ``quick``: three of the feeds."""
    grid = {
        "plane": ["YZ"],
        "radius_mm": [RADIUS_MM],
        "feed_mm_min": list(QUICK_FEEDS_MM_MIN if quick else FEEDS_MM_MIN),
        "repeats": _REPEATS,
    }
    name = "hexapod-sweep-quick" if quick else "hexapod-sweep"
    head = {"name": name, "machine": "virtual-hexapod", "seed": 1}
    return expand({"plan": head, "grid": grid}, "feed sweep")


class VirtualHexapodBench:
    """A hexapod that exists only as legs and equations, with ball bar and accelerometer.

    ``seed``: seed of the machine, its mountings and its noise.
    """

    name = "virtual-hexapod"

    def __init__(self, seed: int = 0) -> None:
        self.machine = VirtualHexapod(seed=seed)

    def describe(self) -> Mapping[str, Mapping[str, Any]]:
        """Return geometry and instrument for the campaign file."""
        bar = self.machine.parameters.bar
        return {
            "machine_geometry": {
                "type": "hexapod",
                "centre_mm": CENTRE_MM.tolist(),
                "tcp_mm": [0.0, 0.0, self.machine.parameters.tool_mm],
                "virtual": True,
            },
            "instrument": {"model": "virtual ballbar", "sample_rate_hz": bar.rate_hz},
        }

    def warm_up(self) -> None:
        """Do nothing: the virtual hexapod has no thermal state."""

    def measure(self, test: PlannedTest, direction: Direction) -> Run:
        """Run one direction of a test on the machine clock."""
        condition = CircleCondition(test.plane, test.radius_mm, test.feed_mm_min, direction)
        measured = self.machine.measure(condition, setup=test.setup, repeat=test.repeat)
        rate_hz = self.machine.parameters.bar.rate_hz
        number = 2 * int(test.test_id[1:]) + (direction == "CW")
        meta = RunMeta(
            f"{test.test_id}-{direction.lower()}",
            plane=test.plane,
            direction=direction,
            radius_mm=test.radius_mm,
            feed_mm_min=test.feed_mm_min,
            repeat=test.repeat,
            setup=test.setup,
            started=(_EPOCH + number * _BETWEEN).isoformat(),
            sample_rate_hz=rate_hz,
            covariates={"temperature_c": 20.0},
        )
        samples = {"t_s": measured.t_s, "angle_deg": measured.angle_deg, "deviation_um": measured.deviation_um}
        return Run(meta, samples, measured.window, (measured.vibration,), "virtual hexapod")

    def close(self) -> None:
        """Do nothing: there is nothing to release."""
