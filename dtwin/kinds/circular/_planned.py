"""Circles before anything moves: order, advice, programs, what they could detect."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from dtwin.acquire.programs import gcode, urscript
from dtwin.kinds.kind import Planned
from dtwin.physics.experiment import REPEATS
from dtwin.physics.state import AXES_OF
from dtwin.plan import Plan, advice, duration_s, expand, training_plan
from dtwin.report.text import table
from dtwin.schema import Run

# Lengths of usual ball bars, the room that their mounts need, and the travel of an axis of which nothing is stated.
_BARS_MM = (50.0, 100.0, 150.0, 300.0)
_ROOM_MM = 100.0
_TRAVEL_MM = 400.0
_MOUNTING_S = 600.0
_COLUMNS = ("test", "setup", "plane", "radius_mm", "feed_mm_min", "repeat")


def planned(document: Mapping[str, Any], where: str) -> Planned:
    """Return circles as their plan file states them."""
    return _shown(expand(document, where))


def usual_plan() -> Planned:
    """Return the training campaign."""
    return _shown(training_plan())


def _shown(plan: Plan) -> Planned:
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
        findings=list(advice(plan)),
        lines=(
            f"{plan.name} on {plan.machine}: {len(plan.tests)} tests, {plan.n_runs} runs, "
            f"{moving_s / 60:z.0f} min of motion, about {total_s / 60:z.0f} min without mounting",
        ),
        order=tuple(vars(test) for test in plan.tests),
        order_text=table(_COLUMNS, rows),
        mounting_s=_MOUNTING_S * len({t.setup for t in plan.tests}),
    )


def programs(circles: Planned, control: str) -> dict[str, str]:
    """Return G-code and URScript of every test, by file name."""
    makers = {".nc": gcode, ".script": urscript}
    plan: Plan = circles.plan
    return {
        f"{test.test_id}{suffix}": make(test, plan.directions) for test in plan.tests for suffix, make in makers.items()
    }


def proposals(machine: str, axes: Mapping[str, Mapping[str, float]]) -> list[dict[str, Any]]:
    """Return plans of one circle, of one at three feeds, and of two at three feeds, in each plane."""
    out = []
    for plane, pair in AXES_OF.items():
        if not set(pair) <= set(axes):
            continue
        radius = _radius_mm(axes, pair)
        for feeds, radii in (
            ([1000.0], [radius]),
            ([500.0, 1500.0, 4000.0], [radius]),
            ([500.0, 1500.0, 4000.0], [radius / 2.0, radius]),
        ):
            name = f"{plane.lower()}-{len(radii)}r-{len(feeds)}f"
            grid = {"radius_mm": radii, "feed_mm_min": feeds, "plane": [plane], "repeats": REPEATS}
            out.append({"plan": {"name": name, "machine": machine, "seed": 1}, "grid": grid})
    return out


def draft(machine: str, axes: Mapping[str, Mapping[str, float]], last: Sequence[Run]) -> dict[str, Any]:
    """Return a plan of the circles of the last test; else of one radius and three feeds in the first plane, both ways."""
    plane, pair = next(((p, pair) for p, pair in AXES_OF.items() if set(pair) <= set(axes)), ("XY", ()))
    grid = {
        "plane": [plane],
        "radius_mm": [_radius_mm(axes, pair)],
        "feed_mm_min": [500.0, 1500.0, 4000.0],
        "directions": ["CCW", "CW"],
        "repeats": REPEATS,
    }
    for name in ("plane", "radius_mm", "feed_mm_min"):
        if then := {value for run in last if (value := getattr(run.meta, name)) is not None}:
            grid[name] = sorted(then)
    return {"plan": {"name": "circles", "machine": machine, "seed": 1}, "grid": grid}


def _radius_mm(axes: Mapping[str, Mapping[str, float]], pair: Iterable[str]) -> float:
    """Return the longest usual bar that has room on both axes."""
    travel_mm = min((axes[axis].get("travel_mm", _TRAVEL_MM) for axis in pair), default=_TRAVEL_MM)
    return max((r for r in _BARS_MM if 2.0 * r + _ROOM_MM <= travel_mm), default=_BARS_MM[0])
