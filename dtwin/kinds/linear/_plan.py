"""A positioning test as data, before anything moves: checked numbers, targets, advice, time."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from dtwin.plan_file import broken_rule, filled
from dtwin.positioning.check import beat_of
from dtwin.schema import Finding, Floats, require_name

_MM_PER: Mapping[str, float] = {"in": 25.4, "mm": 1.0}
# Angles of the screw that show five harmonics of its turn.
_ENOUGH_PHASES = 11
_AXES = "XYZ"
# The limits are those of the published test, in inches, inches a minute and seconds.
_SMALLEST_STEP_IN = 1e-4
_FEED_IN_MIN = (0.1, 50.0)
_DWELL_S = (1.0, 99.0)
_RUNS = (1, 99)
_MOST_OVERSHOOT_IN = 1.0
# Coarser than this, steps of a plan are not written.
_GRAIN = {"in": 1e-4, "mm": 1e-3}
_TURN_S = 0.3


@dataclass(frozen=True)
class LinearPlan:
    """A bidirectional positioning test of one axis; lengths are in ``unit``.

    ``axis``: ``X``, ``Y`` or ``Z``.
    ``unit``: ``in`` or ``mm``.
    ``start``, ``end``, ``step``: first and last target, and from one to the next.
    ``runs``: sweeps forward and back.
    ``dwell_s``: halt of the machine at each target.
    ``feed_min``: feed in ``unit`` a minute.
    ``overshoot``: how far the axis goes beyond both ends before it turns.
    ``axis_low``, ``axis_high``: travel limits of the axis.
    ``pitch``: travel in one turn of the screw; 0 when unknown, or where a linear scale measures the axis.
    ``laser_dwell_s``, ``window``: of the laser's own trigger: it reads when the axis has been within ``window`` of the
    next target for ``laser_dwell_s``.
    """

    name: str
    machine: str
    axis: str
    unit: str
    start: float
    end: float
    step: float
    runs: int
    dwell_s: float
    feed_min: float
    overshoot: float
    axis_low: float
    axis_high: float
    axes: str = "XZ"
    pitch: float = 0.0
    laser_dwell_s: float = 4.0
    window: float = 0.05

    @property
    def count(self) -> int:
        """Number of targets."""
        return round((self.end - self.start) / self.step) + 1

    @property
    def targets(self) -> tuple[float, ...]:
        """Targets from start to end."""
        return tuple(round(self.start + k * self.step, 9) for k in range(self.count))

    @property
    def readings(self) -> int:
        """Readings of the whole test."""
        return 2 * self.count * self.runs

    def mm(self, length: float) -> float:
        """Return a length of the plan in mm."""
        return length * _MM_PER[self.unit]


def linear_plan(stated: Mapping[str, Any], where: str) -> LinearPlan:
    """Return a plan whose numbers obey every rule. ``where``: where they come from, for error messages."""
    plan = filled(LinearPlan, stated, where)
    _check_linear(plan, where)
    return plan


def _check_linear(plan: LinearPlan, where: str) -> None:
    """Refuse a plan that breaks one of the thirteen rules of the published macro."""
    require_name(plan.name, "plan.name")
    require_name(plan.machine, "plan.machine")
    if plan.unit not in _MM_PER:
        raise broken_rule("unit", "the unit of length is unknown", where, plan.unit, "in, mm")
    unit, span = plan.unit, plan.end - plan.start
    inch = 25.4 / _MM_PER[unit]
    smallest = _SMALLEST_STEP_IN * inch
    feeds = (_FEED_IN_MIN[0] * inch, _FEED_IN_MIN[1] * inch)
    over = _MOST_OVERSHOOT_IN * inch
    low, high = plan.axis_low, plan.axis_high
    rules: tuple[tuple[str, bool, str, object, str], ...] = (
        ("axis", plan.axis in tuple(_AXES), "no axis of a machine", plan.axis, "X, Y, Z"),
        ("axis", plan.axis in plan.axes, "the machine has no such axis", plan.axis, plan.axes),
        ("end", plan.start < plan.end, "the test must end above its start", plan.end, f"above {plan.start:g} {unit}"),
        (
            "start",
            low <= plan.start <= high,
            "the start lies outside of the travel",
            plan.start,
            f"{low:g} to {high:g} {unit}",
        ),
        ("end", low <= plan.end <= high, "the end lies outside of the travel", plan.end, f"{low:g} to {high:g} {unit}"),
        ("step", plan.step >= smallest, "the step is too small", plan.step, f"{smallest:g} {unit} or more"),
        ("step", plan.step <= span, "the step is longer than the test", plan.step, f"up to {span:g} {unit}"),
        (
            "step",
            _divides(plan.step, span, smallest),
            "the step does not divide the range",
            plan.step,
            f"a whole fraction of {span:g} {unit}",
        ),
        (
            "dwell_s",
            _DWELL_S[0] <= plan.dwell_s <= _DWELL_S[1],
            "the dwell is out of range",
            plan.dwell_s,
            f"{_DWELL_S[0]:g} to {_DWELL_S[1]:g} s",
        ),
        (
            "runs",
            _RUNS[0] <= plan.runs <= _RUNS[1],
            "the count of runs is out of range",
            plan.runs,
            f"{_RUNS[0]} to {_RUNS[1]}",
        ),
        (
            "feed_min",
            feeds[0] <= plan.feed_min <= feeds[1],
            "the feed is out of range",
            plan.feed_min,
            f"{feeds[0]:g} to {feeds[1]:g} {unit}/min",
        ),
        (
            "overshoot",
            0.0 < plan.overshoot <= over,
            "the overshoot is out of range",
            plan.overshoot,
            f"above 0, up to {over:g} {unit}",
        ),
        (
            "overshoot",
            plan.start - plan.overshoot >= low and plan.end + plan.overshoot <= high,
            "there is no room for the overshoot",
            plan.overshoot,
            f"up to {max(0.0, min(plan.start - low, high - plan.end)):g} {unit}",
        ),
    )
    for name, kept, what, got, allowed in rules:
        if not kept:
            raise broken_rule(name, what, where, got, allowed)


def _divides(step: float, span: float, tolerance: float) -> bool:
    """Tell whether whole steps fit, to the tolerance of the control, counted from both ends."""
    return step > 0.0 and abs(span - round(span / step) * step) < tolerance


def duration_s(plan: LinearPlan) -> float:
    """Return the time of the whole test: dwells, feed motions, turns at both ends."""
    span = plan.end - plan.start
    travel = plan.runs * (2.0 * span + 4.0 * plan.overshoot)
    halts = plan.runs * (2 * plan.count + 2)
    return halts * (plan.dwell_s + _TURN_S) + travel / (plan.feed_min / 60.0)


def _phases(step: float, span: float, pitch: float, grain: float) -> int:
    """Return at how many angles of the screw targets lie.

    ``step``, ``span``, ``pitch``: of the targets, of the whole test, and of the screw, in one unit.
    ``grain``: smallest length that is told apart.
    """
    whole_step, whole_pitch = round(step / grain), round(pitch / grain)
    repeats = whole_pitch // math.gcd(whole_step, whole_pitch)
    return min(repeats, round(span / step) + 1)


def better_step(plan: LinearPlan, longest: float) -> float | None:
    """Return the step nearest to the planned one that divides the range, meets the screw often and does not beat with it.

    ``plan``: has a pitch.
    """
    grain, span = _GRAIN[plan.unit], plan.end - plan.start
    whole = round(span / grain)
    best: float | None = None
    for parts in range(1, min(whole, 100_000) + 1):
        if whole % parts:
            continue
        step = whole // parts * grain
        usable = step <= longest and _phases(step, span, plan.pitch, grain) >= _ENOUGH_PHASES
        if (
            usable
            and beat_of(step, span, plan.pitch) is None
            and (best is None or abs(step - plan.step) < abs(best - plan.step))
        ):
            best = round(step, 6)
    return best


def linear_advice(plan: LinearPlan) -> list[Finding]:
    """Say what the test cannot tell, and where laser and machine will miss each other.

    ``plan``: a plan that breaks no rule.
    """
    return [*_pitch_advice(plan), *_trigger_advice(plan), *_size_advice(plan)]


def _pitch_advice(plan: LinearPlan) -> list[Finding]:
    if plan.pitch <= 0.0:
        return [
            Finding(
                "plan.pitch_unknown", "info", "no pitch of a screw is stated: nothing can be said about a cyclic error"
            )
        ]
    span, unit, findings = plan.end - plan.start, plan.unit, []
    count = _phases(plan.step, span, plan.pitch, _GRAIN[unit])
    if count < _ENOUGH_PHASES:
        step = better_step(plan, math.inf)
        advised = "" if step is None else f"; {step:g} {unit} does better"
        seen = (
            "does not see the cyclic error: it divides into the pitch and is folded into the slow error"
            if count == 1
            else f"meets {count} angles of the screw, enough for {(count - 1) // 2} harmonics of its turn"
        )
        findings.append(
            Finding(
                "plan.step_and_pitch",
                "warning" if count < 5 else "info",
                f"a step of {plan.step:g} {unit} {seen}{advised}",
                {"phases_1": float(count)},
            )
        )
    elif (beat := beat_of(plan.step, span, plan.pitch)) is not None:
        step = better_step(plan, math.inf)
        advised = "" if step is None else f"; {step:g} {unit} does better"
        said = (
            f"equal steps of {plan.step:g} {unit} show a wave of the screw ({beat[0]:g} {unit}) as one of {beat[1]:z.0f} {unit}, which looks like an error of the "
            f"slope{advised}"
        )
        findings.append(Finding("plan.step_beats_pitch", "warning", said, {"alias_1": beat[1] / span}))
    if plan.step > plan.pitch / 10.0 * (1 + 1e-9):
        findings.append(
            Finding(
                "plan.too_coarse_for_a_table",
                "info",
                f"fit to check an axis; a table that is to correct the cyclic error needs steps of "
                f"{plan.pitch / 10:g} {unit} or less",
            )
        )
    return findings


def _trigger_advice(plan: LinearPlan) -> Iterator[Finding]:
    if plan.dwell_s <= plan.laser_dwell_s:
        yield Finding(
            "plan.dwell_too_short",
            "warning",
            f"the machine halts {plan.dwell_s:g} s, the laser wants {plan.laser_dwell_s:g} s "
            "from when the axis enters its window: readings will be missed; halt half as long again",
        )
    if plan.window >= plan.step / 2.0:
        yield Finding(
            "plan.window_too_wide",
            "warning",
            f"windows of {plan.window:g} {plan.unit} around targets {plan.step:g} apart overlap: "
            "the laser may count one halt for two targets",
        )
    if plan.overshoot <= plan.window:
        yield Finding(
            "plan.overshoot_in_window",
            "warning",
            f"the axis turns {plan.overshoot:g} {plan.unit} beyond the ends, within the laser's "
            f"window of {plan.window:g}: the laser cannot tell that it has turned",
        )


def _size_advice(plan: LinearPlan) -> Iterator[Finding]:
    hours = duration_s(plan) / 3600.0
    if hours > 2.0:
        yield Finding(
            "plan.long",
            "warning",
            f"{plan.readings} readings take about {hours:z.0f} h: the machine's temperature will "
            "drift more than readings repeat; take fewer targets or fewer runs, or log temperatures",
            {"duration_s": hours * 3600.0},
        )
    if plan.runs < 2:
        yield Finding("plan.no_repeats", "warning", "one run: the noise floor cannot be known")


def targets_mm(plan: LinearPlan) -> Floats:
    """Return the targets in mm, shape (count,)."""
    return np.array(plan.targets) * _MM_PER[plan.unit]
