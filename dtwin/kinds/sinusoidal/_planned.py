"""A campaign of tones before anything moves: order, advice, what it could detect."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np

from dtwin.kinds.kind import Planned
from dtwin.kinds.sinusoidal._plan import LEARNED_S, ToneGroup, TonePlan, duration_s, tone_advice, tone_plan
from dtwin.physics.observations import Observations, observe
from dtwin.plan_file import plan_settings
from dtwin.schema import Campaign, Run, RunMeta
from dtwin.units import UM_PER_MM

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


def draft(machine: str, axes: Mapping[str, Mapping[str, float]]) -> dict[str, Any]:
    """Return a plan of three frequencies and two amplitudes of the last axis, each three times."""
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
    return {"plan": {"kind": "sinusoidal", **stated}}


def foreseen(tones: Planned) -> Observations:
    """Return the tones of a plan with nothing in them."""
    plan: TonePlan = tones.plan
    campaign = Campaign(plan.name, plan.machine, kind="sinusoidal")
    return observe(campaign, [_empty_run(plan, n, group) for n, group in enumerate(plan.groups, start=1)])


def _empty_run(plan: TonePlan, number: int, group: ToneGroup) -> Run:
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
