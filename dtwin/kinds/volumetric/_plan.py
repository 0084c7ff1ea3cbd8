"""A campaign of a ball array as data, before anything moves: checked numbers, advice, time, what it could detect."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dtwin.kinds.kind import Planned
from dtwin.kinds.volumetric._heat_series import FEWEST_CYCLES
from dtwin.plan_file import filled, obeying, plan_settings
from dtwin.schema import Finding, Run

# Beyond this a ball moves too far while the others are touched.
MOST_DRIFT_UM = 6.0
# Error motions of the chain XZY, and the place of the array in each pose.
_MOTIONS, _PLACE = 24, 6
FEWEST_TABLE_BALLS = 3
_FEWEST_BALLS, _FEWEST_POSES = 3, 4
_REDUNDANCY = 3.0


@dataclass(frozen=True)
class BallPlan:
    """Cycles of a ball array over days.

    ``name``, ``machine``: names of the campaign and of the machine.
    ``every_h``: from the begin of a cycle to that of the next.
    ``balls``, ``poses``: balls of the array, and how often it is put elsewhere in a cycle.
    ``table_balls``: balls that stand on the table, touched at both ends of a cycle.
    ``drift_um_h``: how fast the error of the machine changes when it changes fastest; 0 when unknown.
    """

    name: str
    machine: str
    hours: float
    every_h: float = 1.0
    balls: int = 15
    poses: int = 8
    table_balls: int = 3
    ball_s: float = 27.0
    drift_um_h: float = 0.0

    @property
    def cycles(self) -> int:
        """Number of cycles."""
        return int(self.hours / self.every_h + 1e-9)

    @property
    def touches(self) -> int:
        """Balls that are touched in a cycle."""
        return self.balls * self.poses + 2 * self.table_balls

    @property
    def cycle_h(self) -> float:
        """Length of a cycle."""
        return self.touches * self.ball_s / 3600.0


def _ball_plan(stated: Mapping[str, Any], where: str) -> BallPlan:
    """Return a plan whose numbers obey every rule. ``where``: where they come from, for error messages."""
    plan = filled(BallPlan, stated, where)
    rules = (
        ("hours", 1.0 <= plan.hours <= 10_000.0, plan.hours, "1 to 10000 h"),
        ("every_h", 0.1 <= plan.every_h <= plan.hours, plan.every_h, f"0.1 to {plan.hours:g} h"),
        ("balls", 1 <= plan.balls <= 1000, plan.balls, "1 to 1000"),
        ("poses", 1 <= plan.poses <= 100, plan.poses, "1 to 100"),
        ("table_balls", 0 <= plan.table_balls <= 100, plan.table_balls, "0 to 100"),
        ("ball_s", 1.0 <= plan.ball_s <= 3600.0, plan.ball_s, "1 to 3600 s"),
        ("drift_um_h", 0.0 <= plan.drift_um_h <= 1e4, plan.drift_um_h, "above 0, or 0 when unknown"),
        (
            "every_h",
            plan.cycle_h <= plan.every_h + 1e-9,
            plan.every_h,
            f"{plan.cycle_h:z.2f} h or more: {plan.touches} balls at {plan.ball_s:g} s",
        ),
    )
    return obeying(plan, rules, where)


def ball_advice(plan: BallPlan) -> list[Finding]:
    """Say what the campaign cannot tell. ``plan``: a plan that breaks no rule."""
    return [*_drift_advice(plan), *_ball_advice(plan), *_length_advice(plan)]


def _drift_advice(plan: BallPlan) -> list[Finding]:
    if plan.drift_um_h == 0.0:
        return [
            Finding(
                "plan.drift_unknown",
                "info",
                f"a cycle takes {60.0 * plan.cycle_h:z.0f} min; how fast the machine drifts is not stated "
                "(drift_um_h): nothing can be said about whether that is short enough",
            )
        ]
    moved = plan.drift_um_h * plan.cycle_h
    if moved <= MOST_DRIFT_UM:
        return []
    longest = MOST_DRIFT_UM / plan.drift_um_h
    fitting = int((3600.0 * longest / plan.ball_s - 2 * plan.table_balls) // plan.balls)
    advised = f": {fitting} poses, or less time for a ball" if fitting >= _FEWEST_POSES else ""
    return [
        Finding(
            "plan.cycle_too_long",
            "warning",
            f"in a cycle of {60.0 * plan.cycle_h:z.0f} min the machine moves by up to {moved:z.1f} µm, which "
            f"looks like an error of place; at most {60.0 * longest:z.0f} min{advised}",
            {"moved_um": moved, "longest_h": longest},
        )
    ]


def _ball_advice(plan: BallPlan) -> list[Finding]:
    findings = []
    if plan.table_balls < FEWEST_TABLE_BALLS:
        findings.append(
            Finding(
                "plan.table_balls",
                "warning",
                f"{plan.table_balls} balls on the table: without {FEWEST_TABLE_BALLS} nobody knows how the "
                "tool point moves and turns as a whole, and no cycle can be identified",
            )
        )
    told = 3 * (plan.balls * plan.poses + plan.table_balls)
    unknown = _MOTIONS + _PLACE * plan.poses
    short = plan.balls < _FEWEST_BALLS or plan.poses < _FEWEST_POSES
    if short or told < _REDUNDANCY * unknown:
        findings.append(
            Finding(
                "plan.too_few_balls",
                "warning",
                f"{plan.balls} balls in {plan.poses} poses give {told} readings for {unknown} unknowns "
                f"({_MOTIONS} error motions and the place of the array in each pose); {_REDUNDANCY:g} for "
                f"each unknown, {_FEWEST_BALLS} balls and {_FEWEST_POSES} poses are needed to hold poses "
                "out as a check",
                {"readings_1": float(told), "unknowns_1": float(unknown)},
            )
        )
    return findings


def _length_advice(plan: BallPlan) -> list[Finding]:
    findings = [
        Finding(
            "plan.one_campaign",
            "info",
            "one campaign cannot judge its own model: plan another under another schedule of heat, in "
            "another season, as warm as the machine ever gets",
        )
    ]
    if plan.cycles < FEWEST_CYCLES:
        findings.append(
            Finding(
                "plan.too_few_cycles",
                "warning",
                f"{plan.cycles} cycles; {FEWEST_CYCLES} are needed to choose temperatures and to leave "
                "spans of hours out",
                {"cycles_1": float(plan.cycles)},
            )
        )
    return findings


def planned(document: Mapping[str, Any], where: str) -> Planned:
    """Return cycles of a ball array as their plan file states them."""
    plan = _ball_plan(plan_settings(document, where), where)
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


def draft(machine: str, axes: object, last: Sequence[Run]) -> dict[str, Any]:
    """Return a plan of a day, with a cycle each hour; of the array and the poses of the last test."""
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
    begun_h = np.unique([float(run.meta.condition["time_h"]) for run in last if "time_h" in run.meta.condition])
    if begun_h.size > 1:
        every_h = round(float(np.diff(begun_h).min()), 3)
        stated |= {"every_h": every_h, "hours": round(float(np.ptp(begun_h)) + every_h, 3)}
    if last and {"pose_1", "ball_1"} <= last[0].samples.keys():
        pose, ball = last[0].samples["pose_1"], last[0].samples["ball_1"]
        stated["table_balls"] = max(FEWEST_TABLE_BALLS, np.unique(ball[pose == 0]).size)
        stated |= {"balls": np.unique(ball[pose > 0]).size, "poses": np.unique(pose[pose > 0]).size}
        stated["ball_s"] = round(float(np.median(np.diff(last[0].samples["t_s"]))), 1)
    return {"plan": {"kind": "volumetric", **stated}}
