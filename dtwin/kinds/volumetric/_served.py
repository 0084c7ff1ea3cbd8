"""The virtual mill that heat deforms, touching its balls, for corrections that come while it runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from dtwin.kinds.volumetric._plan import BallPlan
from dtwin.kinds.volumetric._simulate import MACHINE, QUICK_EVERY, parameters_of, planned_cycles, write_ball_campaign
from dtwin.machines.thermal_network import SCHEDULES
from dtwin.machines.volumetric import CYCLE_S, READING_S, VolumetricMill
from dtwin.schema import Floats

_PERIOD_S = 0.02
# From one ball to the next, and at rest before the probe touches; nothing moves between.
_TRAVEL, _REST = 50, 50
_BALL = _TRAVEL + _REST
_CYCLES, _QUICK_CYCLES = 24, 6


class ServedMill:
    """Cycles of a ball array on a mill in the course of its days.

    States are sent while the mill goes to a ball and rests there; the time between is left out.

    ``plan``: hours, and how often; three days, every third hour, without.
    ``truth``: where its thermocouples sit.
    ``schedule``: as for :func:`dtwin.kinds.volumetric._simulate.simulate_volumetric`.
    ``quick``: six cycles, where there is no plan.
    """

    name = "virtual three-axis mill"
    period_s = _PERIOD_S
    axes = ("x", "y", "z")
    channels_hz = 0.0

    def __init__(self, plan: BallPlan | None, truth: str, schedule: str, seed: int, *, quick: bool) -> None:
        self._mill = VolumetricMill(SCHEDULES[schedule], parameters_of(truth), seed)
        self._machine = plan.machine if plan else MACHINE
        n = _QUICK_CYCLES if quick else _CYCLES
        self._cycles: Sequence[int] = (
            planned_cycles(plan, self._mill) if plan else range(0, QUICK_EVERY * n, QUICK_EVERY)
        )
        self._balls = [self._mill.measure(cycle) for cycle in self._cycles]
        places = np.concatenate([readings.nominal_mm for readings in self._balls])
        self._to_mm = places
        self._from_mm = np.vstack([places[:1], places[:-1]])
        self._at_s = np.concatenate([readings.t_s for readings in self._balls])
        self._temperatures = [self._read(cycle) for cycle in self._cycles]
        self._per_cycle = len(self._balls[0].t_s)
        self.provides = ("x_mm", "y_mm", "z_mm", *self._temperatures[0])
        self._offset_um = np.zeros((len(places), 3))

    @property
    def ticks(self) -> int:
        """Length of the program."""
        return len(self._to_mm) * _BALL

    def state(self, tick: int) -> Mapping[str, float]:
        """Return the commanded place, and temperatures when the mill sets out for a ball."""
        ball, within = divmod(tick, _BALL)
        share = min((within + 1) / _TRAVEL, 1.0)
        x, y, z = (self._from_mm[ball] + share * (self._to_mm[ball] - self._from_mm[ball])).tolist()
        now_s = float(self._at_s[ball]) - (_BALL - 1 - within) * _PERIOD_S
        figures = {"timestamp_s": now_s, "x_mm": x, "y_mm": y, "z_mm": z}
        if within == 0:
            number = ball // self._per_cycle
            since_s = max(now_s - self._cycles[number] * CYCLE_S, 0.0)
            row = int(since_s / READING_S)
            figures |= {name: float(values[row]) for name, values in self._temperatures[number].items()}
        return figures

    def advance(self, tick: int, offset_um: Floats) -> None:
        """Take what is in force; the last of a ball is there when the probe touches."""
        self._offset_um[tick // _BALL] = offset_um

    def write(self, folder: Path) -> str:
        """Write the readings as a campaign folder; return what was written."""
        parts = np.split(self._offset_um, len(self._balls))
        # The scales read less where the correction lets the machine go further.
        readings = [
            replace(found, error_um=found.error_um - offset) for found, offset in zip(self._balls, parts, strict=True)
        ]
        write_ball_campaign(
            folder,
            folder.name,
            self._machine,
            self._cycles,
            readings,
            self._mill,
            corrected=bool(self._offset_um.any()),
        )
        return f"{len(readings)} cycles of the ball array"

    def _read(self, cycle: int) -> dict[str, Floats]:
        return {**self._mill.thermocouples_c(cycle), **self._mill.control_c(cycle)}
