"""A campaign of a ball array before anything moves: advice and time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dtwin.kinds.kind import Planned
from dtwin.kinds.volumetric._plan import ball_advice, ball_plan
from dtwin.plan_file import plan_settings


def planned(document: Mapping[str, Any], where: str) -> Planned:
    """Return cycles of a ball array as their plan file states them."""
    plan = ball_plan(plan_settings(document, where), where)
    return Planned(
        kind="volumetric",
        plan=plan,
        summary={
            "name": plan.name,
            "machine": plan.machine,
            "kind": "volumetric",
            "cycles": plan.cycles,
            "cycle_s": 3600.0 * plan.cycle_h,
        },
        duration_s=3600.0 * plan.hours,
        findings=ball_advice(plan),
        lines=(
            f"{plan.name} on {plan.machine}: {plan.cycles} cycles of {60.0 * plan.cycle_h:z.0f} min, one "
            f"every {plan.every_h:g} h, {plan.touches} balls in each, {plan.hours:g} h in all",
        ),
    )


def draft(machine: str, axes: object) -> dict[str, Any]:
    """Return a plan of a day, with a cycle each hour."""
    stated: dict[str, Any] = {
        "name": "ball-array",
        "machine": machine,
        "hours": 24.0,
        "every_h": 1.0,
        "balls": 15,
        "poses": 8,
        "table_balls": 3,
        "ball_s": 27.0,
        "drift_um_h": 0.0,
    }
    return {"plan": {"kind": "volumetric", **stated}}
