"""The virtual lathe under a program, for corrections that come while it runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from dtwin.kinds.linear._bundle import told
from dtwin.kinds.linear._plan import LinearPlan
from dtwin.kinds.linear._simulate import (
    laser_setup,
    motion_of_plan,
    reverse_at,
    truth_of,
    verification_plan,
    virtual_lathe,
    write_lathe_campaign,
)
from dtwin.schema import Floats
from dtwin.units import UM_PER_MM

_PERIOD_S = 0.01


class ServedLathe:
    """One axis on its way through a positioning program; the laser looks on.

    ``plan``: what the laser measures; one run of the published verification without.
    ``truth``: as for :func:`dtwin.kinds.linear._simulate.virtual_lathe`.
    """

    period_s = _PERIOD_S
    provides = tuple(told(np.zeros(1), np.zeros(1)))
    channels_hz = 0.0

    def __init__(self, plan: LinearPlan | None, truth: str, seed: int) -> None:
        self._plan = plan or replace(verification_plan(), runs=1)
        self._lathe = virtual_lathe(truth, seed)
        self._told = truth_of(self._lathe, truth, seed)
        self._motion = motion_of_plan(self._plan)
        begun, ended = self._motion.t_s[0], self._motion.t_s[-1]
        self._t_s = np.arange(begun, ended + _PERIOD_S, _PERIOD_S)
        self._commanded_mm = self._motion.at(self._t_s)
        self._reverse = reverse_at(self._commanded_mm)
        self._offset_um = np.zeros(len(self._t_s))
        self.axes = (self._plan.axis.lower(),)
        self._axis = "xyz".index(self.axes[0])
        self.name = f"virtual lathe, axis {self._plan.axis}"

    @property
    def ticks(self) -> int:
        """Length of the program."""
        return len(self._t_s)

    def state(self, tick: int) -> Mapping[str, float]:
        """Return the commanded position before a tick."""
        here = told(self._commanded_mm[tick : tick + 1], self._reverse[tick : tick + 1])
        return {name: float(values[0]) for name, values in here.items()}

    def advance(self, tick: int, offset_um: Floats) -> None:
        """Take what is in force from the next cycle on: the control reads its inputs once in each."""
        if tick + 1 < len(self._offset_um):
            self._offset_um[tick + 1] = offset_um[self._axis]

    def write(self, folder: Path) -> str:
        """Write what the laser read as a campaign folder; return what was written."""
        screw_mm = self._commanded_mm + self._offset_um / UM_PER_MM
        seen = self._lathe.measure(self._motion, laser_setup(self._plan), self._t_s, screw_mm)
        write_lathe_campaign(
            folder, replace(self._plan, name=folder.name), seen, self._told, corrected=bool(self._offset_um.any())
        )
        return f"{len(seen.error_um)} readings of the laser"
