"""The virtual cobot as a bench: same files, same readers, known truth."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np

from dtwin.acquire.b5r import marked_angle_deg
from dtwin.machines.cobot import CircleCondition, CobotRecording, VirtualCobot
from dtwin.plan import PlannedTest
from dtwin.schema import Direction, Plane, Run, RunMeta, SignalGroup

_SINGLE = ("_g", "_rad_s", "_mm_s", "_um")
# A correction arrives one controller period after the state that it answers.
TRANSPORT_S = 0.002
EPOCH = datetime(2026, 3, 2, 8, 0, tzinfo=UTC)


class VirtualCobotBench:
    """A UR10e that exists only as equations of motion, with ball bar and accelerometers.

    The seed is of the machine, its set-ups and its noise.
    """

    name = "virtual-cobot"

    def __init__(self, seed: int = 0) -> None:
        self.cobot = VirtualCobot(seed=seed)

    def describe(self) -> Mapping[str, Mapping[str, Any]]:
        """Return geometry and instrument for the campaign file."""
        motion, controller = self.cobot.parameters.motion, self.cobot.parameters.controller
        delay_s = controller.actuator_delay_s + controller.actuator_lag_s + TRANSPORT_S
        return {
            "machine_geometry": {
                "type": "ur10e",
                "tcp_mm": [0.0, 0.0, motion.tcp_z_mm],
                "centre_small_mm": [motion.centre_x_small_mm, motion.centre_y_mm, motion.centre_z_mm],
                "centre_large_mm": [motion.centre_x_large_mm, motion.centre_y_mm, motion.centre_z_mm],
                "large_radius_from_mm": motion.large_radius_from_mm,
                "correction_delay_s": delay_s,
                "virtual": True,
            },
            "instrument": {"model": "virtual ballbar", "sample_rate_hz": 200.0},
        }

    def warm_up(self) -> None:
        """Do nothing: the virtual robot has no thermal state."""

    def measure(self, test: PlannedTest, direction: Direction) -> Run:
        """Run one direction of a test on the machine clock."""
        condition = CircleCondition(test.plane, test.radius_mm, test.feed_mm_min, direction)
        recording = self.cobot.measure(condition, setup=test.setup, repeat=test.repeat)
        # A date of its own for every run, the same whether or not the campaign was interrupted.
        minutes = 10 * int(test.test_id[1:]) + (5 if direction == "CW" else 0)
        started = EPOCH + timedelta(minutes=minutes)
        return run_of(recording, f"{test.test_id}-{direction.lower()}", test.plane, started)

    def close(self) -> None:
        """Do nothing: there is nothing to release."""


def run_of(recording: CobotRecording, run_id: str, plane: Plane, started: datetime) -> Run:
    """Return a recording of the virtual cobot as a run that states this standard plane and time."""
    condition = recording.condition
    direction: Direction = "CCW" if condition.direction == "CCW" else "CW"
    arc_deg = 360.0 if plane == "XY" else 180.0
    n = len(recording.deviation_mm)
    samples = {
        "t_s": np.arange(n) / recording.sample_rate_hz,
        "angle_deg": marked_angle_deg(n, recording.window, direction, 0.0, arc_deg),
        "deviation_um": recording.deviation_mm * 1000.0,
    }
    meta = RunMeta(
        run_id=run_id,
        plane=plane,
        direction=direction,
        radius_mm=condition.radius_mm,
        feed_mm_min=condition.feed_mm_min,
        repeat=recording.repeat,
        setup=recording.setup,
        started=started.isoformat(),
        sample_rate_hz=recording.sample_rate_hz,
        covariates={"temperature_c": 20.0},
    )
    groups = tuple(_compact(group) for group in recording.groups)
    return Run(meta, samples, recording.window, groups, "virtual cobot")


def _compact(group: SignalGroup) -> SignalGroup:
    """Keep what is measured in single precision: a converter has 24 bits."""
    columns = {
        name: values.astype(np.float32) if name.endswith(_SINGLE) else values
        for name, values in group.columns.items()
        if not name.startswith("actual_qd")
    }
    return SignalGroup(group.name, group.rate_hz, columns, group.start_s)
