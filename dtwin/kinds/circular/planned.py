"""Circles before anything moves: order, advice, programs, what they could detect."""

from __future__ import annotations

from dtwin.acquire.programs import gcode, urscript
from dtwin.kinds.kind import Planned
from dtwin.physics.experiment import Detectable, detectable, planned_observations
from dtwin.physics.library import Library
from dtwin.plan import Plan, advice, duration_s
from dtwin.report.text import table

_COLUMNS = ("test", "setup", "plane", "radius_mm", "feed_mm_min", "repeat")


def planned(plan: Plan) -> Planned:
    """Return circles as ``dtwin plan`` shows them."""
    moving_s, total_s = duration_s(plan)
    rows = [[t.test_id, t.setup, t.plane, t.radius_mm, t.feed_mm_min, t.repeat] for t in plan.tests]
    return Planned(
        kind="circular",
        plan=plan,
        summary={
            "name": plan.name,
            "machine": plan.machine,
            "tests": len(plan.tests),
            "runs": plan.n_runs,
            "motion_s": moving_s,
        },
        duration_s=total_s,
        findings=advice(plan),
        lines=(
            f"{plan.name} on {plan.machine}: {len(plan.tests)} tests, {plan.n_runs} runs, "
            f"{moving_s / 60:z.0f} min of motion, about {total_s / 60:z.0f} min in all",
        ),
        order=tuple(vars(test) for test in plan.tests),
        order_text=table(_COLUMNS, rows),
    )


def programs(plan: Plan) -> dict[str, str]:
    """Return G-code and URScript of every test, by file name."""
    makers = {".nc": gcode, ".script": urscript}
    return {
        f"{test.test_id}{suffix}": make(test, plan.directions) for test in plan.tests for suffix, make in makers.items()
    }


def detected(plan: Plan, noise_um: float) -> list[Detectable]:
    """Return the size from which each effect is seen on the circles."""
    return detectable(planned_observations(plan), Library(), noise_um=noise_um)
