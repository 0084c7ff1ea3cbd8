"""Programs of straight moves (MoveL) and joint moves (MoveJ) that stop at every target."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from dtwin.errors import InputError
from dtwin.kinematics import UR10E
from dtwin.machines.cobot import ELBOW_UP_RAD, TOOL_DOWN, VirtualCobot
from dtwin.machines.mechanism import run_joints_kernel
from dtwin.machines.motion import (
    COLUMNS,
    DURATION_S,
    JERK_S,
    KIND,
    LENGTH,
    LINE,
    LINE_FROM,
    RAMP_S,
    SPEED,
    MotionPlan,
    line_segment,
    travelled_kernel,
)
from dtwin.schema import Floats

MOTIONS = ("MoveL", "MoveJ")


@dataclass(frozen=True)
class Waypoint:
    """One target of a program.

    ``position_mm``, shape (3,): in the base frame; the tool points down.
    ``dwell_s``: standstill there before the next move.
    """

    name: str
    position_mm: Floats
    dwell_s: float = 0.2


def drive_program(
    cobot: VirtualCobot, stops: list[Waypoint], *, motion: str, feed_mm_min: float, datum_mm: Floats
) -> tuple[Floats, float]:
    """Return where the tool is when the dwell at each stop ends, and how long it all took.

    ``stops``: the first is where the tool rests at the start.
    ``motion``: straight in space, or straight in joint angles.
    ``feed_mm_min``: speed along the straight line; a joint move takes as long as the straight one.
    ``datum_mm``, shape (3,): where the robot's frame was set: the error is zero there.
    Returns, shape (len(stops), 3): positions in mm, and duration in s.
    Raises ``InputError`` when there is no such motion, or a target is out of reach.
    """
    if motion not in MOTIONS:
        raise InputError("no such motion", code="joints.motion", got=motion[:40], allowed=", ".join(MOTIONS))
    tick_s = 1.0 / cobot.parameters.controller.rate_hz
    first = _plan_at(stops[0].position_mm, datum_mm)
    mechanism, memory = cobot.at_rest(first)
    tcp = mechanism.geometry[0]
    q = UR10E.inverse(stops[0].position_mm, TOOL_DOWN, tcp, ELBOW_UP_RAD)
    path = [np.repeat(q[None], max(1, round(stops[0].dwell_s / tick_s)), axis=0)]
    for here, there in pairwise(stops):
        share = _shares(cobot, here.position_mm, there.position_mm, feed_mm_min, tick_s)
        if motion == "MoveL":
            way = there.position_mm - here.position_mm
            line = here.position_mm + share[:, None] * way
            moved = UR10E.inverse_many(line, TOOL_DOWN, tcp, q)
        else:
            goal = UR10E.inverse(there.position_mm, TOOL_DOWN, tcp, q)
            moved = q + share[:, None] * (goal - q)
        q = moved[-1]
        dwell = np.repeat(q[None], max(1, round(there.dwell_s / tick_s)), axis=0)
        path.append(np.concatenate([moved, dwell]))
    joints = np.ascontiguousarray(np.concatenate(path))
    tool = np.empty((len(joints), 3))
    run_joints_kernel(mechanism, joints, memory, tool)
    ends = np.cumsum([len(part) for part in path]) - 1
    return tool[ends], len(joints) * tick_s


def _plan_at(position_mm: Floats, datum_mm: Floats) -> MotionPlan:
    """Return a plan that only says where the tool rests and where the frame was set."""
    row = np.zeros(COLUMNS)
    row[KIND] = LINE
    row[LINE_FROM : LINE_FROM + 3] = position_mm
    return MotionPlan(row[None], np.vstack([np.eye(3)[:2], datum_mm]), 0.0, (0.0, 0.0))


def _shares(cobot: VirtualCobot, start_mm: Floats, end_mm: Floats, feed_mm_min: float, tick_s: float) -> Floats:
    """Return the share of the way travelled at each tick of a move."""
    length = float(np.linalg.norm(end_mm - start_mm))
    if length < 1e-6:
        return np.ones(1)
    row = line_segment(length, feed_mm_min / 60.0, cobot.parameters.motion)
    times = tick_s * np.arange(1, int(np.ceil(row[DURATION_S] / tick_s)) + 1)
    shape = row[DURATION_S], row[SPEED], row[RAMP_S], row[JERK_S]
    way = [travelled_kernel(min(t, row[DURATION_S]), *shape) for t in times.tolist()]
    return np.minimum(np.array(way) / row[LENGTH], 1.0)
