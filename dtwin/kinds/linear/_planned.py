"""A positioning test before anything moves: advice, program for controls that know nothing of the laser, what it could detect."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dtwin.acquire.programs import NO_DIAMETERS
from dtwin.errors import InputError
from dtwin.kinds.kind import Planned
from dtwin.kinds.linear._plan import LinearPlan, better_step, duration_s, linear_advice, linear_plan, targets_mm
from dtwin.physics.observations import Observations, observe
from dtwin.plan_file import plan_settings
from dtwin.schema import Campaign, Run, RunMeta
from dtwin.units import UM_PER_MM

# Intervals and sweeps of a short test and of one after ISO 230-2; turns beyond the ends; the travel of an axis of
# which nothing is stated; the time to mount and align a laser.
_SIZES = ((10, 3), (20, 5))
_OVERSHOOT_MM = 5.0
# Of the laser's trigger: an axis that is further off is not read.
_WINDOW_MM = 0.05
_TRAVEL_MM = 400.0
_ROOM = 2.0
_MOUNTING_S = 2700.0


def planned(document: Mapping[str, Any], where: str) -> Planned:
    """Return a positioning test as its plan file states it."""
    plan = linear_plan(plan_settings(document, where), where)
    total_s = duration_s(plan)
    return Planned(
        kind="linear",
        plan=plan,
        summary={
            "name": plan.name,
            "machine": plan.machine,
            "kind": "linear",
            "axis": plan.axis,
            "targets": plan.count,
            "runs": plan.runs,
            "readings": plan.readings,
        },
        duration_s=total_s,
        findings=linear_advice(plan),
        lines=(
            f"{plan.name} on {plan.machine}: axis {plan.axis}, {plan.count} targets from {plan.start:g} "
            f"to {plan.end:g} {plan.unit}, {plan.runs} runs, {plan.readings} readings, about "
            f"{total_s / 3600:z.1f} h",
        ),
        mounting_s=_MOUNTING_S,
    )


def programs(test: Planned, control: str) -> dict[str, str]:
    """Return the program of the test, by file name."""
    return {f"{test.plan.name}.nc": laser_program(test.plan, control)}


def foreseen(test: Planned) -> Observations:
    """Return the sweeps of a plan with nothing in them."""
    return observe(_campaign_of(test.plan), _empty_runs(test.plan))


def proposals(machine: str, axes: Mapping[str, Mapping[str, float]]) -> list[dict[str, Any]]:
    """Return a short and a full plan of each axis; targets meet the screw at many angles where its pitch is known."""
    return [_proposal(machine, axis, axes[axis], *size) for axis in "XYZ" if axis in axes for size in _SIZES]


def draft(machine: str, axes: Mapping[str, Mapping[str, float]], last: Sequence[Run]) -> dict[str, Any]:
    """Return a full plan of the axis and the stretch of the last test; else of the first axis.

    A stretch outside of the stated travel was counted from a zero of its own: the axis has a plan of its travel then.
    """
    axis = next((axis for axis in "XYZ" if axis in axes), "X")
    tested = str(last[0].meta.condition.get("axis", "")) if last else ""
    if tested not in tuple("XYZ"):
        return _proposal(machine, axis, axes.get(axis, {}), *_SIZES[-1])
    known, positions = axes.get(tested, {}), last[0].samples["position_mm"]
    targets = np.unique(np.round(positions, 3))
    document = _proposal(machine, tested, known, *_SIZES[-1])
    off_mm = float(np.abs(last[0].samples["error_um"]).max()) / UM_PER_MM
    first_mm, step = float(targets[0]), round(float(np.median(np.diff(targets))), 3) if targets.size > 1 else 0.0
    if step <= 0.0:
        return document
    end_mm = round(first_mm + round((float(targets[-1]) - first_mm) / step) * step, 3)
    low_mm = known.get("low_mm", min(0.0, first_mm - _OVERSHOOT_MM))
    travel_mm = known.get("travel_mm", max(_TRAVEL_MM, end_mm + _OVERSHOOT_MM - low_mm))
    if first_mm < low_mm or end_mm > low_mm + travel_mm:
        return document
    document["plan"] |= {
        "name": f"{tested.lower()}-{round((end_mm - first_mm) / step) + 1}-targets",
        "start": first_mm,
        "end": end_mm,
        "step": step,
        "runs": max(1, round(positions.size * len(last) / (2 * targets.size))),
        "overshoot": min(_OVERSHOOT_MM, first_mm - low_mm, low_mm + travel_mm - end_mm),
        "axis_low": low_mm,
        "axis_high": low_mm + travel_mm,
        "pitch": known.get("pitch_mm", float(last[0].meta.condition.get("screw_pitch_mm", 0.0))),
        "window": round(min(max(_WINDOW_MM, _ROOM * off_mm), step / 4.0), 3),
    }
    return document


def _proposal(machine: str, axis: str, known: Mapping[str, float], intervals: int, runs: int) -> dict[str, Any]:
    travel_mm, low_mm = known.get("travel_mm", _TRAVEL_MM), known.get("low_mm", 0.0)
    step = max(1.0, math.floor((travel_mm - 2.0 * _OVERSHOOT_MM) / intervals))
    stated: dict[str, Any] = {
        "name": f"{axis.lower()}-{intervals + 1}-targets",
        "machine": machine,
        "axis": axis,
        "axes": "XYZ",
        "unit": "mm",
        "start": low_mm + _OVERSHOOT_MM,
        "end": low_mm + _OVERSHOOT_MM + intervals * step,
        "step": step,
        "runs": runs,
        "dwell_s": 5.0,
        "feed_min": 1000.0,
        "overshoot": _OVERSHOOT_MM,
        "axis_low": low_mm,
        "axis_high": low_mm + travel_mm,
        "pitch": known.get("pitch_mm", 0.0),
        "window": _WINDOW_MM,
    }
    plan = linear_plan(stated, "the proposal")
    better = better_step(plan, 2.0 * step) if plan.pitch > 0.0 else None
    return {"plan": {"kind": "linear", **stated, **({"step": better} if better else {})}}


def _campaign_of(plan: LinearPlan) -> Campaign:
    """Return the campaign that a plan becomes."""
    pitch = {"screw_pitch_mm": plan.mm(plan.pitch)} if plan.pitch > 0.0 else {}
    return Campaign(plan.name, plan.machine, kind="linear", machine_geometry=pitch)


def _empty_runs(plan: LinearPlan) -> list[Run]:
    """Return the runs of a plan as if they had been measured, each up and down, with no error."""
    up = targets_mm(plan)
    position, ways = np.concatenate([up, up[::-1]]), np.repeat(["forward", "reverse"], len(up))
    condition: dict[str, float | str] = {"axis": plan.axis, "feed_mm_min": plan.mm(plan.feed_min)}
    each_s = duration_s(plan) / plan.runs
    samples = {
        "t_s": np.linspace(0.0, each_s, len(position)),
        "position_mm": position,
        "direction": ways.astype(object),
        "error_um": np.zeros(len(position)),
    }
    return [
        Run(RunMeta(str(n), kind="linear", repeat=n, setup="s1", condition=condition), samples)
        for n in range(1, plan.runs + 1)
    ]


_CONTROLS = ("opencnc", "iso")


def laser_program(plan: LinearPlan, control: str = "opencnc") -> str:
    """Return the program of a bidirectional test.

    Each run overshoots below the start, sweeps up with a halt at every target, overshoots above the
    end and sweeps down. Before the first run the program stops so that the laser can be zeroed at
    the start; after each run there is an optional stop.

    ``control``: ``opencnc``: machine coordinates in every block and ``G04F``, as the published test used; ``iso``:
    ``G20``/``G21``, ``G04 P`` in milliseconds, ``M30``, axis in machine coordinates by ``G53``. Neither was run on a
    control.
    """
    if control not in _CONTROLS:
        raise InputError(
            "no programs are written for this control",
            code="plan.control",
            got=control[:40],
            allowed=", ".join(_CONTROLS),
        )
    words = _Words(plan, control)
    lines = words.head()
    for run in range(1, plan.runs + 1):
        lines += _one_run(plan, words, run)
    return "\n".join([*lines, *words.tail(), ""])


class _Words:
    """The words of one control."""

    def __init__(self, plan: LinearPlan, control: str) -> None:
        self.plan = plan
        self.iso = control == "iso"

    def head(self) -> list[str]:
        inch = self.plan.unit == "in"
        remark = [NO_DIAMETERS] if self.plan.axis == "X" else []
        if self.iso:
            return ["%", *remark, "G20" if inch else "G21", "G90 G94"]
        return [*remark, "G70" if inch else "G71", "G01G59G90G94 (modes)"]

    def tail(self) -> list[str]:
        return ["M30", "%"] if self.iso else []

    def move(self, target: float, *, with_feed: bool = False) -> str:
        feed = f"F{_number(self.plan.feed_min, whole_point=True)}"
        if self.iso:
            return f"G53 G01 {self.plan.axis}{_number(target)} {feed}"
        return f"G53{self.plan.axis}{_number(target)}{feed if with_feed else ''}"

    def dwell(self) -> str:
        seconds = self.plan.dwell_s
        return f"G04 P{seconds * 1000:z.0f}" if self.iso else f"G04F{seconds:g}"


def _one_run(plan: LinearPlan, words: _Words, run: int) -> list[str]:
    low, high = plan.start - plan.overshoot, plan.end + plan.overshoot
    lines = [words.move(plan.start, with_feed=True)] if run == 1 else []
    lines += [words.move(low, with_feed=True), words.dwell()]
    lines += [words.move(plan.start, with_feed=True)]
    lines.append("M00 (zero the laser)" if run == 1 else words.dwell())
    lines.append(f"(run {run} of {plan.runs})")
    for target in plan.targets[1:]:
        lines += [words.move(target), words.dwell()]
    lines += [words.move(high), words.dwell()]
    for target in reversed(plan.targets):
        lines += [words.move(target), words.dwell()]
    return [*lines, f"M01 (end of run {run})"]


def _number(value: float, *, whole_point: bool = False) -> str:
    """Return a number as controls read it: always with its point, no needless zeros."""
    text = f"{value:z.6f}".rstrip("0")
    if text.endswith(".") and not whole_point:
        text += "0"
    return text
