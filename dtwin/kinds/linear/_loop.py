"""Before and after on the virtual lathe: a correction in the loop, watched by the laser."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dtwin.errors import InputError
from dtwin.kinds.linear._bundle import RATE_HZ, axis_number, told
from dtwin.kinds.linear._gates import along
from dtwin.kinds.linear._models import PositionModel
from dtwin.kinds.linear._plan import LinearPlan
from dtwin.kinds.linear._report import before_after_figures
from dtwin.kinds.linear._simulate import laser_setup, motion_of_plan, reverse_at
from dtwin.machines.lathe import LatheRecording, VirtualLathe
from dtwin.positioning.matrix import LinearTest
from dtwin.schema import Floats
from dtwin.serve.bundle import Bundle
from dtwin.serve.safety import Guard
from dtwin.units import UM_PER_MM

PERIOD_S = 1.0 / RATE_HZ
Figures = dict[str, float | None]


@dataclass(frozen=True)
class _LoopRun:
    """One corrected test.

    ``figures``: the four figures of a before/after table, um.
    ``guard``: how often each reason of the guard acted.
    ``largest_step_um``: largest change of the correction in one cycle.
    """

    test: LinearTest
    figures: Figures
    ticks: int
    guard: dict[str, int]
    largest_step_um: float


def _test_of(recording: LatheRecording, plan: LinearPlan) -> LinearTest:
    """Return a recording of a whole plan in matrices. ``recording``: every reading of the plan, none missed."""
    if len(recording.error_um) != plan.readings:
        raise InputError(
            "the laser missed readings", code="lathe.missed", got=f"{len(recording.error_um)} of {plan.readings}"
        )
    cube = recording.error_um.reshape(plan.runs, 2, plan.count)
    targets = np.array([plan.mm(t) for t in plan.targets])
    pitch = plan.mm(plan.pitch)
    return LinearTest(targets, cube[:, 0].T, cube[:, 1, ::-1].T, 0, pitch)


def measured(lathe: VirtualLathe, plan: LinearPlan, model: PositionModel | None = None) -> LinearTest:
    """Measure a plan, corrected at its halts by a model that takes a flag for the direction.

    ``model``: the correction; none without.
    """
    motion = motion_of_plan(plan)
    if model is None:
        return _test_of(lathe.measure(motion, laser_setup(plan)), plan)
    screw = motion.position_mm - model.error_um(reverse_at(motion.position_mm), motion.position_mm) / UM_PER_MM
    return _test_of(lathe.measure(motion, laser_setup(plan), motion.t_s, screw), plan)


def looped(lathe: VirtualLathe, plan: LinearPlan, bundle: Bundle) -> _LoopRun:
    """Measure a plan while a bundle corrects every 10 ms, through the guard, one cycle late.

    ``bundle``: predicts the error from the commanded position.
    """
    motion = motion_of_plan(plan)
    ticks = np.arange(motion.t_s[0], motion.t_s[-1] + PERIOD_S, PERIOD_S)
    commanded = motion.at(ticks)
    wanted = np.zeros((len(ticks), 3))
    moved = axis_number(bundle)
    wanted[:, moved] = -along(bundle, commanded)
    named = told(commanded, np.zeros(len(ticks)))
    guard = Guard(bundle.safety, *bundle.box)
    box = np.column_stack([named[i.name] for i in bundle.inputs])
    sent = guard.run(wanted, box, elapsed_s=PERIOD_S)[:, moved]
    applied = np.concatenate([[0.0], sent[:-1]])
    recording = lathe.measure(motion, laser_setup(plan), ticks, commanded + applied / UM_PER_MM)
    test = _test_of(recording, plan)
    return _LoopRun(
        test=test,
        figures=before_after_figures(test),
        ticks=len(ticks),
        guard=guard.counted(),
        largest_step_um=float(np.max(np.abs(np.diff(sent[1:])))),
    )


@dataclass(frozen=True)
class ExactCorrection:
    """A correction that knows the screw: what would be left if the screw were known exactly: drift and noise of the test itself."""

    lathe: VirtualLathe

    def error_um(self, direction: Floats, position_mm: Floats) -> Floats:
        there = position_mm - self._flank_um(direction, position_mm) / UM_PER_MM
        return self._flank_um(direction, there)

    def _flank_um(self, direction: Floats, position_mm: Floats) -> Floats:
        lower, upper = self.lathe.screw.flanks_um(position_mm)
        return np.where(direction >= 0.5, upper, lower)
