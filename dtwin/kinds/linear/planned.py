"""A positioning test before anything moves: advice, program, what it could detect."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from dtwin.kinds.kind import Planned
from dtwin.kinds.linear.plan import LinearPlan, duration_s, linear_advice, linear_plan, targets_mm
from dtwin.kinds.linear.program import laser_program
from dtwin.physics.experiment import Detectable, detectable
from dtwin.physics.library import Library
from dtwin.physics.observations import observe
from dtwin.plan_file import plan_settings
from dtwin.schema import Campaign, Run, RunMeta


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
    )


def programs(plan: LinearPlan, control: str) -> dict[str, str]:
    """Return the program of the test, by file name."""
    return {f"{plan.name}.nc": laser_program(plan, control)}


def detected(plan: LinearPlan, noise_um: float) -> list[Detectable]:
    """Return the size from which each effect is seen on the sweeps."""
    obs = observe(_campaign_of(plan), _empty_runs(plan))
    return detectable(obs, Library(), noise_um=noise_um)


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
