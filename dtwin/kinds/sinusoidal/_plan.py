"""A campaign of tones as data, before anything moves: checked numbers, order, advice, time, what it could detect."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np

from dtwin.kinds.kind import Planned
from dtwin.physics.observations import Observations, observe
from dtwin.plan_file import filled, obeying, plan_settings
from dtwin.schema import Campaign, Finding, Run, RunMeta
from dtwin.units import UM_PER_MM, shown_number

# Share of the control bandwidth up to which a slide may be driven.
SAFE_SHARE = 0.8
FEWEST_PER_PERIOD = 10.0
# Five seconds for the features, one for what they foretell.
LEARNED_S, FORETOLD_S = 6.0, 1.0
# The slide swings in before a group, and the next one is set up.
BETWEEN_S = 2.5
_FEWEST_TONES = 3
_MOST_GROUPS = 2000
_LONG_H = 2.0
_G_PER_UM_HZ2 = (2.0 * math.pi) ** 2 * 1e-6 / 9.80665
# What a good accelerometer's noise leaves of a tone that is weaker.
_WEAK_G = 3e-4


@dataclass(frozen=True)
class _ToneGroup:
    """One group: what is commanded, and which repeat it is."""

    frequency_hz: float
    amplitude_um: float
    repeat: int


@dataclass(frozen=True)
class TonePlan:
    """Every amplitude at every frequency, several times.

    ``name``, ``machine``: names of the campaign and of the machine.
    ``repeats``: how often each group is measured.
    ``bandwidth_hz``: control bandwidth of the axis; 0 when unknown.
    ``seed``: of the order: every repeat is a pass over all groups in an order of its own.
    """

    name: str
    machine: str
    frequencies_hz: tuple[float, ...]
    amplitudes_um: tuple[float, ...]
    repeats: int = 1
    seconds: float = LEARNED_S
    axis: str = "Z"
    bandwidth_hz: float = 0.0
    sample_hz: float = 1000.0
    seed: int = 1

    @property
    def groups(self) -> tuple[_ToneGroup, ...]:
        """All groups in the order of measuring, so that drift is no amplitude and no frequency."""
        rng = np.random.default_rng(self.seed)
        grid = [(f, a) for f in self.frequencies_hz for a in self.amplitudes_um]
        return tuple(
            _ToneGroup(grid[i][0], grid[i][1], repeat)
            for repeat in range(1, self.repeats + 1)
            for i in rng.permutation(len(grid))
        )

    @property
    def count(self) -> int:
        """Number of groups, repeats counted."""
        return len(self.frequencies_hz) * len(self.amplitudes_um) * self.repeats


def tone_plan(stated: Mapping[str, Any], where: str) -> TonePlan:
    """Return a plan whose numbers obey every rule. ``where``: where they come from, for error messages."""
    plan = filled(TonePlan, stated, where)
    rules = (
        (
            "frequencies_hz",
            _distinct(plan.frequencies_hz, 1e4),
            plan.frequencies_hz,
            "different frequencies above 0, up to 10000 Hz",
        ),
        (
            "amplitudes_um",
            _distinct(plan.amplitudes_um, 1e5),
            plan.amplitudes_um,
            "different amplitudes above 0, up to 100000 µm",
        ),
        ("repeats", 1 <= plan.repeats <= 99, plan.repeats, "1 to 99"),
        ("repeats", plan.count <= _MOST_GROUPS, f"{plan.count} groups", f"{_MOST_GROUPS} in all"),
        ("seconds", 1.0 <= plan.seconds <= 600.0, plan.seconds, "1 to 600 s"),
        ("axis", plan.axis in ("X", "Y", "Z"), plan.axis, "X, Y, Z"),
        ("bandwidth_hz", 0.0 <= plan.bandwidth_hz <= 1e5, plan.bandwidth_hz, "above 0, or 0 when unknown"),
        ("sample_hz", 1.0 <= plan.sample_hz <= 1e6, plan.sample_hz, "1 to 1000000 Hz"),
        ("seed", plan.seed >= 0, plan.seed, "0 or more"),
    )
    return obeying(plan, rules, where)


def duration_s(plan: TonePlan) -> float:
    """Return the time of the whole campaign."""
    return plan.count * (plan.seconds + BETWEEN_S)


def tone_advice(plan: TonePlan) -> list[Finding]:
    """Say what may harm the slide, and what the campaign cannot tell. ``plan``: a plan that breaks no rule."""
    return [*_drive_advice(plan), *_sampling_advice(plan), *_size_advice(plan)]


def _drive_advice(plan: TonePlan) -> Iterator[Finding]:
    if plan.bandwidth_hz == 0.0:
        yield Finding(
            "plan.bandwidth_unknown",
            "info",
            "the control bandwidth of the axis is not stated: nothing can be said about how fast it may be driven",
        )
        return
    limit = SAFE_SHARE * plan.bandwidth_hz
    beyond = [f for f in plan.frequencies_hz if f > limit + 1e-9]
    if not beyond:
        return
    yield Finding(
        "plan.beyond_safe",
        "warning",
        f"{_list(beyond)} Hz lie beyond the safe limit of {limit:g} Hz ({SAFE_SHARE:g} of the "
        f"axis's bandwidth of {plan.bandwidth_hz:g} Hz): such groups are refused at ingest",
        {"limit_hz": limit},
    )


def _sampling_advice(plan: TonePlan) -> Iterator[Finding]:
    few = [f for f in plan.frequencies_hz if plan.sample_hz < FEWEST_PER_PERIOD * f]
    if few:
        yield Finding(
            "plan.too_few_samples",
            "warning",
            f"{_list(few)} Hz at {plan.sample_hz:g} samples a second have "
            f"{plan.sample_hz / max(few):z.1f} samples to a period: peaks are missed, and below 2 "
            f"the tone is another one; {FEWEST_PER_PERIOD * max(few):g} Hz would do",
        )
    slow = [f for f in plan.frequencies_hz if f * FORETOLD_S < 1.0]
    if slow:
        yield Finding(
            "plan.too_slow",
            "warning",
            f"{_list(slow)} Hz make less than a period in the last second, where amplitude and lag are taken",
        )
    if plan.seconds < LEARNED_S:
        yield Finding(
            "plan.too_short",
            "warning",
            f"{plan.seconds:g} s of a group: features need {LEARNED_S - FORETOLD_S:g} s, what they "
            f"foretell {FORETOLD_S:g} s more",
        )
    weakest = min(plan.frequencies_hz) ** 2 * min(plan.amplitudes_um) * _G_PER_UM_HZ2
    if weakest < _WEAK_G:
        yield Finding(
            "plan.weak",
            "info",
            f"the weakest tone accelerates by {shown_number(weakest, 1)} g: an accelerometer may hear only its "
            "own noise, and such groups are left out of the training",
            {"weakest_g": weakest},
        )


def _size_advice(plan: TonePlan) -> Iterator[Finding]:
    if plan.repeats < 2:
        yield Finding("plan.no_repeats", "warning", "no repeats: the noise floor cannot be known")
    if min(len(plan.frequencies_hz), len(plan.amplitudes_um)) < _FEWEST_TONES:
        yield Finding(
            "plan.too_few_tones",
            "warning",
            f"{len(plan.frequencies_hz)} frequencies and {len(plan.amplitudes_um)} amplitudes: a "
            f"model is judged by leaving one out, which needs {_FEWEST_TONES} of each",
        )
    hours = duration_s(plan) / 3600.0
    if hours > _LONG_H:
        yield Finding(
            "plan.long",
            "warning",
            f"{plan.count} groups take about {hours:z.1f} h: the slide will not stay as it was",
            {"duration_s": hours * 3600.0},
        )


def _distinct(values: tuple[float, ...], most: float) -> bool:
    return len(set(values)) == len(values) and all(0.0 < v <= most for v in values)


def _list(values: list[float]) -> str:
    return ", ".join(f"{v:g}" for v in values)


_EPOCH = datetime(2026, 1, 1, tzinfo=UTC)
_ENOUGH_PER_PERIOD, _SLOWEST_HZ, _ENOUGH_S = 20.0, 100.0, 2.0


def planned(document: Mapping[str, Any], where: str) -> Planned:
    """Return tones as their plan file states them."""
    plan = tone_plan(plan_settings(document, where), where)
    total_s, groups = duration_s(plan), plan.groups
    first = ", ".join(f"{g.frequency_hz:g} Hz {g.amplitude_um:g} µm" for g in groups[:3])
    return Planned(
        kind="sinusoidal",
        plan=plan,
        summary={
            "name": plan.name,
            "machine": plan.machine,
            "kind": "sinusoidal",
            "axis": plan.axis,
            "groups": plan.count,
        },
        duration_s=total_s,
        findings=tone_advice(plan),
        lines=(
            f"{plan.name} on {plan.machine}: axis {plan.axis}, {len(plan.frequencies_hz)} frequencies, "
            f"{len(plan.amplitudes_um)} amplitudes, {plan.repeats} times, {plan.count} groups of "
            f"{plan.seconds:g} s, about {total_s / 60.0:z.0f} min",
            f"  in random order (seed {plan.seed}), repeat by repeat: {first} ...",
        ),
        order=tuple(vars(group) for group in groups),
    )


def draft(machine: str, axes: Mapping[str, Mapping[str, float]], last: Sequence[Run]) -> dict[str, Any]:
    """Return a plan of the tones of the last test, else of three frequencies and two amplitudes of the last axis; each three times."""
    stated: dict[str, Any] = {
        "name": "tones",
        "machine": machine,
        "axis": next((axis for axis in "ZYX" if axis in axes), "Z"),
        "frequencies_hz": [2.0, 5.0, 10.0],
        "amplitudes_um": [50.0, 100.0],
        "repeats": 3,
        "seconds": LEARNED_S,
        "sample_hz": 1000.0,
        "bandwidth_hz": 0.0,
        "seed": 1,
    }
    then = [run.meta.condition for run in last]
    if then and {"axis", "frequency_hz", "amplitude_um"} <= then[0].keys():
        axis = str(then[0]["axis"])
        stated["axis"] = axis
        stated["bandwidth_hz"] = float(then[0].get(f"{axis.lower()}_bandwidth_hz", 0.0))
        for name, one in (("frequencies_hz", "frequency_hz"), ("amplitudes_um", "amplitude_um")):
            stated[name] = sorted({float(condition[one]) for condition in then})
    return {"plan": {"kind": "sinusoidal", **stated}}


def foreseen(tones: Planned) -> Observations:
    """Return the tones of a plan with nothing in them."""
    plan: TonePlan = tones.plan
    campaign = Campaign(plan.name, plan.machine, kind="sinusoidal")
    return observe(campaign, [_empty_run(plan, n, group) for n, group in enumerate(plan.groups, start=1)])


def _empty_run(plan: TonePlan, number: int, group: _ToneGroup) -> Run:
    """Return a tone as if it had been measured, with a tool that does what it is told.

    It is as short and as slowly sampled as its harmonics allow: only the condition counts.
    """
    rate_hz = min(plan.sample_hz, max(_ENOUGH_PER_PERIOD * group.frequency_hz, _SLOWEST_HZ))
    t_s = np.arange(round(min(plan.seconds, _ENOUGH_S) * rate_hz)) / rate_hz
    told_mm = group.amplitude_um / UM_PER_MM * np.sin(2.0 * np.pi * group.frequency_hz * t_s)
    axis = plan.axis.lower()
    condition: dict[str, float | str] = {
        "axis": plan.axis,
        "amplitude_um": group.amplitude_um,
        "frequency_hz": group.frequency_hz,
    }
    begun = timedelta(seconds=(number - 1) * duration_s(plan) / plan.count)
    meta = RunMeta(
        str(number),
        kind="sinusoidal",
        repeat=group.repeat,
        setup="s1",
        condition=condition,
        started=(_EPOCH + begun).isoformat(),
        sample_rate_hz=rate_hz,
    )
    return Run(meta, {"t_s": t_s, f"cmd_{axis}_mm": told_mm, f"tool_{axis}_mm": told_mm})
