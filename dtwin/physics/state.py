"""Where a machine was, how it moved and what was logged, at each point of a run.

Effects are functions of this state and of nothing else, so that one library serves every kind
of campaign.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from dtwin.errors import InputError
from dtwin.schema import Floats, RunMeta

AXES_OF: Mapping[str, tuple[str, str]] = {"XY": ("X", "Y"), "YZ": ("Y", "Z"), "ZX": ("Z", "X")}
_ROBOT = "ur10e"
_TOOL_DOWN = np.diag([-1.0, 1.0, -1.0])
_ELBOW_UP_RAD = np.radians([-18.5, -86.3, 137.0, -140.7, -90.0, -108.5])
_GRAVITY_M_S2 = 9.80665


@dataclass(frozen=True)
class Joints:
    """Joint motion of a robot along a run.

    Attributes:
        q_rad, qd_rad_s: Angle and speed of every joint. Shape (n, joints).
        lever_mm: Change of the measured length per radian of each joint: mm/rad. Shape (n, joints).
        gravity_nmm: Moment of a unit mass (1 kg) at the tool about each joint axis, N*mm. Shape (n, joints).
    """

    q_rad: Floats
    qd_rad_s: Floats
    lever_mm: Floats
    gravity_nmm: Floats


@dataclass(frozen=True)
class State:
    """State of the machine at the points of one run.

    Attributes:
        plane: Plane of a circular run, else empty.
        position_mm: Position of each axis, from the centre of the path. Shape (n,) each.
        velocity_mm_s, acceleration_mm_s2: Motion of each axis. Shape (n,) each.
        sensitivity: Change of the measured length per unit of error along the axis. Shape (n,) each.
        since_reversal_s: Time since the axis last changed direction. Shape (n,) each.
        last_end: +1 when that was at the positive end of its travel, else -1. Shape (n,) each.
        angle_rad: Path angle of a circular run. Shape (n,).
        radius_mm, feed_mm_s, direction: Condition of a circular run; the direction is +1 for CCW, -1 for CW.
        columns: Session time ``time_h`` and everything that was logged. Shape (n,) each.
        geometry: ``machine_geometry`` of the campaign.
    """

    kind: str
    axes: tuple[str, ...]
    plane: str
    position_mm: Mapping[str, Floats]
    velocity_mm_s: Mapping[str, Floats]
    acceleration_mm_s2: Mapping[str, Floats]
    sensitivity: Mapping[str, Floats]
    since_reversal_s: Mapping[str, Floats]
    last_end: Mapping[str, Floats]
    angle_rad: Floats
    radius_mm: float
    feed_mm_s: float
    direction: float
    columns: Mapping[str, Floats] = field(default_factory=dict)
    geometry: Mapping[str, Any] = field(default_factory=dict)

    @property
    def n(self) -> int:
        """Number of points."""
        return int(self.angle_rad.size)

    def column(self, name: str) -> Floats:
        """Return a logged column.

        Args:
            name: Name with unit, for example ``"temperature_c"``.

        Raises:
            InputError: When it was not logged for this run.
        """
        if name in self.columns:
            return self.columns[name]
        raise InputError(
            "an effect needs a column that was not logged",
            code="state.column",
            got=name,
            allowed=", ".join(sorted(self.columns)) or "none was logged",
        )

    @cached_property
    def joints(self) -> Joints:
        """Joint motion of the robot that the campaign's geometry describes.

        Raises:
            InputError: When the geometry is missing or describes no known robot.
        """
        return _joints(self)


def has_joints(geometry: Mapping[str, Any]) -> bool:
    """Tell whether a campaign's geometry describes a robot that dtwin knows.

    Args:
        geometry: ``machine_geometry`` of the campaign.
    """
    known = str(geometry.get("type", "")).lower() == _ROBOT
    return known and ("centre_mm" in geometry or "centre_small_mm" in geometry)


def circular_state(
    meta: RunMeta, angle_rad: Floats, *, feed_mm_s: float, columns: Mapping[str, Floats], geometry: Mapping[str, Any]
) -> State:
    """Return the state along a circle.

    Args:
        angle_rad: Path angles. Shape (n,).
        feed_mm_s: Path speed that was really reached.
        columns: What was logged. Shape (n,) each.
        geometry: ``machine_geometry`` of the campaign.
    """
    if meta.plane is None or meta.radius_mm is None or meta.direction is None:
        raise InputError(
            "a circular run needs plane, radius and direction", code="state.condition", where=f"run {meta.run_id}"
        )
    radius, sign = meta.radius_mm, 1.0 if meta.direction == "CCW" else -1.0
    first, second = AXES_OF[meta.plane]
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    omega = feed_mm_s / radius
    # Angle travelled along the motion, whichever way it turns.
    travelled = sign * angle_rad
    offset = {first: 0.0, second: sign * np.pi / 2.0}
    since, end = {}, {}
    for axis in (first, second):
        # An axis reverses where it is furthest out: the first at 0 and 180 deg.
        turned = (travelled - offset[axis]) % (2.0 * np.pi)
        since[axis] = (turned % np.pi) / omega
        end[axis] = np.where(turned < np.pi, 1.0, -1.0)
    return State(
        kind="circular",
        axes=(first, second),
        plane=meta.plane,
        position_mm={first: radius * cos, second: radius * sin},
        velocity_mm_s={first: -sign * feed_mm_s * sin, second: sign * feed_mm_s * cos},
        acceleration_mm_s2={first: -(omega**2) * radius * cos, second: -(omega**2) * radius * sin},
        sensitivity={first: cos, second: sin},
        since_reversal_s=since,
        last_end=end,
        angle_rad=angle_rad,
        radius_mm=radius,
        feed_mm_s=feed_mm_s,
        direction=sign,
        columns=columns,
        geometry=geometry,
    )


def _centre_mm(geometry: Mapping[str, Any], radius_mm: float) -> Floats:
    """Return the centre of the circle in base coordinates; it may depend on the radius."""
    if "centre_mm" in geometry:
        return np.asarray(geometry["centre_mm"], dtype=float)
    size = "large" if radius_mm >= float(geometry["large_radius_from_mm"]) else "small"
    return np.asarray(geometry[f"centre_{size}_mm"], dtype=float)


def _joints(state: State) -> Joints:
    kind = str(state.geometry.get("type", "")).lower()
    if kind != _ROBOT:
        raise InputError(
            "joint effects need the robot's geometry",
            code="state.geometry",
            got=kind or "no machine_geometry",
            allowed=_ROBOT,
            hint="add [campaign.machine_geometry] with type, centre_mm and tcp_mm",
        )
    # Its kernels need numba, which no other campaign has to wait for.
    from dtwin.kinematics import UR10E

    geometry = state.geometry
    tcp = np.asarray(geometry.get("tcp_mm", (0.0, 0.0, 0.0)), dtype=float)
    branch = np.asarray(geometry.get("joint_branch", _ELBOW_UP_RAD), dtype=float)
    position = np.tile(_centre_mm(geometry, state.radius_mm), (state.n, 1))
    normal = np.zeros((state.n, 3))
    for axis in state.axes:
        number = "XYZ".index(axis)
        position[:, number] += state.position_mm[axis]
        normal[:, number] = state.sensitivity[axis]
    q_rad = UR10E.inverse_many(position, _TOOL_DOWN, tcp, branch)
    # The path angle is the only clock of a circular run; it rises for CCW and falls for CW.
    rate_rad_s = state.direction * state.feed_mm_s / state.radius_mm
    qd_rad_s = np.gradient(q_rad, state.angle_rad, axis=0) * rate_rad_s
    jacobians = np.array([UR10E.position_jacobian(q, tcp) for q in q_rad])
    lever = np.einsum("ni,nij->nj", normal, jacobians)
    return Joints(q_rad, qd_rad_s, lever, -_GRAVITY_M_S2 * jacobians[:, 2, :])
