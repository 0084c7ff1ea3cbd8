"""The laser looks at the virtual lathe on days with a correction, and on others without it; before and after, a correction in the loop."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import timedelta

import numpy as np

from dtwin.acquire.virtual import EPOCH
from dtwin.errors import InputError
from dtwin.kinds.linear._bundle import RATE_HZ, axis_number, is_positioning_bundle, told
from dtwin.kinds.linear._gates import along, screw_logged
from dtwin.kinds.linear._models import MM_PER_IN, PositionModel
from dtwin.kinds.linear._plan import LinearPlan, better_step
from dtwin.kinds.linear._report import before_after_figures
from dtwin.kinds.linear._simulate import laser_setup, motion_of_plan, reverse_at, verification_plan, virtual_lathe
from dtwin.machines.lathe import LatheRecording, VirtualLathe
from dtwin.positioning.matrix import LinearTest
from dtwin.progress import Progress, silent
from dtwin.schema import Floats, Run, RunMeta
from dtwin.serve.bundle import Bundle
from dtwin.serve.safety import Guard
from dtwin.train.oracle import MeasuredWays, guard_shares, numbered
from dtwin.units import UM_PER_MM

_DAYS = 3
_CLOCK = "machine clock, 10 ms cycle, one cycle late"
_TARGETS = 60


def measured_days(
    bundle: Bundle, logged: Mapping[str, float], truth: str, seed: int, progress: Progress = silent
) -> MeasuredWays:
    """Measure the mapped travel on several days with a bundle, and on as many between without.

    Every day has its own drift and noise. The oracle is an exact map on the days without.

    ``logged``: what its training logged: mapped travel and pitch.
    ``truth``: as for :func:`dtwin.kinds.linear._simulate.virtual_lathe`.
    """
    if not is_positioning_bundle(bundle):
        raise InputError("the bundle does not correct a position", code="lathe.bundle", got=bundle.name)
    pitch_mm, low_mm, high_mm = screw_logged(logged)
    axis = "XYZ"[axis_number(bundle)]
    plan = evidence_plan((low_mm, high_mm), pitch_mm, bundle.machine, axis)
    runs: list[Run] = []
    oracle: list[Run] = []
    guards: list[Mapping[str, int]] = []
    for day in range(_DAYS):
        first = 1000 * (seed + 1) + 10 * day
        lathe = virtual_lathe(truth, first)
        runs.append(_run_of_test(measured(lathe, plan), plan.axis, 2 * day))
        oracle.append(_run_of_test(measured(lathe, plan, ExactCorrection(lathe)), plan.axis, 2 * day))
        served = looped(virtual_lathe(truth, first + 1), plan, bundle)
        runs.append(_run_of_test(served.test, plan.axis, 2 * day + 1, bundle.model_sha256))
        guards.append(served.guard)
        progress(day + 1, _DAYS, "days")
    shares = guard_shares(guards)
    return MeasuredWays(
        numbered(runs),
        _CLOCK,
        {"one cycle of the loop": PERIOD_S},
        tuple(oracle),
        {f"{plan.axis} {way}": shares for way in ("forward", "reverse")},
    )


def _run_of_test(test: LinearTest, axis: str, day: int, correction: str = "") -> Run:
    """Return readings of a test of one run as a run of the lake.

    ``test``: every target once in each direction.
    ``correction``: as for :class:`RunMeta`.
    """
    there, back = test.position_mm, test.position_mm[::-1]
    n = len(there)
    samples = {
        "t_s": np.arange(2.0 * n),
        "position_mm": np.concatenate([there, back]),
        "direction": np.repeat(np.array(["forward", "reverse"], dtype=object), n),
        "error_um": np.concatenate([test.forward_um[:, 0], test.reverse_um[::-1, 0]]),
    }
    meta = RunMeta(
        "e",
        kind="linear",
        condition={"axis": axis},
        correction=correction,
        sample_rate_hz=1.0,
        started=(EPOCH + timedelta(days=day)).isoformat(),
    )
    return Run(meta, samples, source="virtual lathe")


def evidence_plan(reach_mm: tuple[float, float], pitch_mm: float, machine: str, axis: str = "Z") -> LinearPlan:
    """Return a test, in inches as the virtual lathe's, over the mapped travel, whose step meets the screw at many angles.

    ``pitch_mm``: travel in one turn of the screw; 0 where a linear scale measures the axis.
    """
    low, high = (round(end / MM_PER_IN, 4) for end in reach_mm)
    span = round(high - low, 4)
    head = replace(
        verification_plan(),
        name="evidence",
        machine=machine,
        axis=axis,
        start=low,
        end=high,
        runs=1,
        step=span / _TARGETS,
        axis_low=low - 1.0,
        axis_high=high + 1.0,
        pitch=pitch_mm / MM_PER_IN,
    )
    step = (better_step(head, span / 8.0) if pitch_mm else None) or head.step
    return replace(head, step=step, window=min(head.window, step / 4.0))


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
