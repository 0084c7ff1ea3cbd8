"""Errors of a robot's joints, through its kinematics: pose errors of the tool, not formulas."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from causes import Cause

from dtwin.kinematics import UR10E
from dtwin.machines.mill import Disturbance, Moment
from dtwin.schema import Floats
from dtwin.units import UM_PER_MM

TCP_MM = (0.0, 0.0, 150.0)
CENTRE_MM = (-100.0, -650.0, 200.0)
GEOMETRY: dict[str, Any] = {"type": "ur10e", "centre_mm": list(CENTRE_MM), "tcp_mm": list(TCP_MM)}
# Joints that a circle can show; turning the base by a constant only moves the centre.
JOINTS = {"joint_offset": (2, 3, 4), "joint_compliance": (2, 3), "joint_reversal": (1, 2, 3), "joint_cyclic": (1, 2, 3)}
_TOOL_DOWN = np.diag([-1.0, 1.0, -1.0])
_START_RAD = np.radians([-18.5, -86.3, 137.0, -140.7, -90.0, -108.5])
_POINTS = 720
_NEWTON_PER_KG = 9.80665


def joint_cause(effect: str, rng: np.random.Generator) -> Cause:
    """Return a fault of one joint; its size is in the unit of the library's parameter."""
    joint = int(rng.choice(JOINTS[effect]))
    order, phase = float(rng.integers(8, 60)), rng.uniform(0.0, 2.0 * np.pi)

    def sized(size: float) -> Disturbance:
        def act(moment: Moment) -> Floats:
            sense = 1.0 if moment.test.direction == "CCW" else -1.0
            return _bar_um(effect, joint, moment, sense, size, (order, phase))

        return act

    start = 0.5 if effect == "joint_compliance" else 5.0
    return Cause(f"{effect} {joint}", start, disturbance=sized, signed=effect != "joint_reversal")


@lru_cache(maxsize=16)
def _path(radius_mm: float, sense: float) -> tuple[Floats, Floats]:
    """Return path angles and joint angles of half a turn of lead-in and one turn."""
    angle = sense * np.linspace(-np.pi, 2.0 * np.pi + 0.05, int(1.51 * _POINTS))
    at = np.tile(np.array(CENTRE_MM), (len(angle), 1))
    at[:, 0] += radius_mm * np.cos(angle)
    at[:, 1] += radius_mm * np.sin(angle)
    first = UR10E.inverse_many(np.linspace(np.array(CENTRE_MM), at[0], 20), _TOOL_DOWN, np.array(TCP_MM), _START_RAD)
    return angle, UR10E.inverse_many(at, _TOOL_DOWN, np.array(TCP_MM), first[-1])


def _bar_um(effect: str, joint: int, moment: Moment, sense: float, size: float, wave: tuple[float, float]) -> Floats:
    radius = moment.test.radius_mm
    angle, wanted = _path(radius, sense)
    reached = wanted.copy()
    at = joint - 1
    q = wanted[:, at]
    if effect == "joint_reversal":
        reached[:, at] = _play(q, 0.5e-6 * size)
    elif effect == "joint_cyclic":
        reached[:, at] = q + 1e-6 * size * np.cos(wave[0] * q + wave[1])
    elif effect == "joint_compliance":
        reached[:, at] = q + 1e-6 * size * _moment_nm(wanted, at)
    else:
        reached[:, at] = q + 1e-6 * size
    tool, _ = UR10E.forward_many(reached, np.array(TCP_MM))
    length = np.linalg.norm(tool - np.array(CENTRE_MM), axis=1) - radius
    return np.interp(sense * moment.angle_rad, sense * angle, UM_PER_MM * length)


def _play(q_rad: Floats, half_rad: float) -> Floats:
    out = q_rad.copy()
    for i in range(1, len(q_rad)):
        out[i] = max(q_rad[i] - half_rad, min(q_rad[i] + half_rad, out[i - 1]))
    return out


def _moment_nm(q_rad: Floats, at: int) -> Floats:
    """Return the moment of 1 kg at the tool about a joint, by virtual work."""
    step = np.zeros(6)
    step[at] = 1e-5
    up, _ = UR10E.forward_many(q_rad + step, np.array(TCP_MM))
    down, _ = UR10E.forward_many(q_rad - step, np.array(TCP_MM))
    return -_NEWTON_PER_KG * (up[:, 2] - down[:, 2]) / (2e-5 * UM_PER_MM)
