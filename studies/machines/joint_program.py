"""Programs of straight moves (MoveL) and joint moves (MoveJ) that stop at every target."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from dtwin.errors import InputError
from dtwin.kinematics import UR10E, forward_kernel, kernel
from dtwin.machines._structure import modes_kernel
from dtwin.machines.cobot import ELBOW_UP_RAD, TOOL_DOWN, VirtualCobot
from dtwin.machines.mechanism import _MODES, _Q, _RIGID1, _RIGID2, _STARTED, _TICK_S, Mechanism, _link_angles
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
    _run_joints(mechanism, joints, memory, tool)
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


@kernel
def _run_joints(machine: Mechanism, q_rad: Floats, memory: Floats, tool_mm: Floats) -> None:
    """Follow joint angles, shape (n, 6), tick by tick and write where the tool is, shape (n, 3).

    The same gears, friction and structure as ``tick_kernel``, for programs that move in joint
    space; the correction registers play no part.
    """
    tick_s, tcp = machine.control[_TICK_S], machine.geometry[0]
    actual, link = np.empty(6), np.empty(6)
    shaken, jolt = np.empty(3), np.zeros(3)
    true, flange = np.empty(3), np.empty(3)
    for n in range(q_rad.shape[0]):
        _link_angles(q_rad[n], machine, memory, actual, link)
        rigid, _ = forward_kernel(link, machine.dh[1], tcp)
        if memory[_STARTED] == 0.0:
            memory[_STARTED] = 1.0
            for i in range(3):
                memory[_RIGID1 + i] = rigid[i]
                memory[_RIGID2 + i] = rigid[i]
        for i in range(3):
            bend = rigid[i] - 2.0 * memory[_RIGID1 + i] + memory[_RIGID2 + i]
            shaken[i] = bend / tick_s**2
            true[i] = rigid[i] - machine.geometry[1, i]
            flange[i] = true[i]
            memory[_RIGID2 + i] = memory[_RIGID1 + i]
            memory[_RIGID1 + i] = rigid[i]
        place = memory[_MODES : _MODES + 8]
        reach = np.hypot(rigid[0], rigid[1])
        modes_kernel(machine.modes, tick_s, q_rad[n, 0], reach, shaken, jolt, place, true, flange)
        for j in range(6):
            memory[_Q + j] = q_rad[n, j]
        for i in range(3):
            tool_mm[n, i] = true[i]
