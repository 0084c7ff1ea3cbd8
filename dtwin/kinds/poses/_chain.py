"""Serial chains of a robot, what small errors of them do at the tool, and the set-up that is always fitted: instrument and target."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from dtwin.errors import InputError
from dtwin.kinematics import UR10E
from dtwin.schema import Floats

_QUARTER = np.pi / 2
_COLUMNS = ("a_mm", "d_mm", "alpha_deg", "theta_deg")


def _cobot(a2_mm: float, a3_mm: float, d_mm: tuple[float, float, float, float]) -> Floats:
    d1, d4, d5, d6 = d_mm
    return np.array(
        [
            [0.0, d1, _QUARTER, 0.0],
            [a2_mm, 0.0, 0.0, 0.0],
            [a3_mm, 0.0, 0.0, 0.0],
            [0.0, d4, _QUARTER, 0.0],
            [0.0, d5, -_QUARTER, 0.0],
            [0.0, d6, 0.0, 0.0],
        ]
    )


# As the manufacturer publishes them: a in mm, d in mm, alpha and theta in rad.
KNOWN: Mapping[str, Floats] = {
    "ur5": _cobot(-425.0, -392.25, (89.159, 109.15, 94.65, 82.3)),
    "ur10": _cobot(-612.0, -572.3, (127.3, 163.941, 115.7, 92.2)),
    "ur10e": UR10E.dh,
}


@dataclass(frozen=True)
class Frames:
    """Frames of a chain at many poses, in the base frame.

    ``origin_mm`` (joints + 1, n, 3): of the base and of the frame after every joint.
    ``rotation`` (joints + 1, n, 3, 3): the same.
    """

    origin_mm: Floats
    rotation: Floats

    def tool_mm(self, offset_mm: Floats) -> Floats:
        """Return the point (n, 3) that stands at ``offset_mm`` (3,) in the last frame."""
        return self.origin_mm[-1] + self.rotation[-1] @ offset_mm


def chain_of(geometry: Mapping[str, Any], where: str) -> Floats:
    """Return the Denavit-Hartenberg rows that a campaign states, shape (joints, 4).

    ``geometry``: ``chain`` is a known name; or ``dh`` a list of tables a_mm, d_mm, alpha_deg, theta_deg, one a joint, 0 where
    one is not stated.
    Raises ``InputError`` when it states neither, or a row has other names, or values that are no finite numbers.
    """
    rows = geometry.get("dh")
    if isinstance(rows, list) and rows:
        try:
            table = np.array([[float(row.get(name, 0.0)) for name in _COLUMNS] for row in rows])
            others = sorted({name for row in rows for name in row} - set(_COLUMNS))
        except (AttributeError, TypeError, ValueError) as error:
            raise _refused(where, str(error)) from error
        if others or not np.isfinite(table).all():
            raise _refused(where, f"dh with {', '.join(others) or 'numbers that are not finite'}")
        table[:, 2:] = np.radians(table[:, 2:])
        return table
    name = str(geometry.get("chain", "")).lower()
    if name not in KNOWN:
        raise _refused(where, name or "no chain")
    return KNOWN[name]


def _refused(where: str, got: str) -> InputError:
    return InputError(
        "the robot's chain is not known",
        code="poses.chain",
        where=f"{where} campaign.machine_geometry",
        got=got[:80],
        allowed=f"chain = one of {', '.join(KNOWN)}; or dh = [{{ {' = …, '.join(_COLUMNS)} = … }}, …], one a joint; "
        'or urdf = "robot.urdf"',
        hint="state it under [campaign.machine_geometry] of a campaign.toml; the figures of ISO 9283 need no joints: those columns may be left out",
    )


def frames(joints_rad: Floats, dh: Floats) -> Frames:
    """Return the frames of a chain at joint angles of shape (n, joints)."""
    n = len(joints_rad)
    rotation, origin = [np.broadcast_to(np.eye(3), (n, 3, 3))], [np.zeros((n, 3))]
    for angle, (a, d, alpha, theta) in zip(joints_rad.T, dh, strict=True):
        c, s = np.cos(angle + theta), np.sin(angle + theta)
        ca, sa = np.cos(alpha), np.sin(alpha)
        zero, one = np.zeros(n), np.ones(n)
        turn = np.stack([c, -s * ca, s * sa, s, c * ca, -c * sa, zero, sa * one, ca * one], axis=1).reshape(n, 3, 3)
        step = np.stack([a * c, a * s, d * one], axis=1)
        origin.append(origin[-1] + (rotation[-1] @ step[:, :, None])[:, :, 0])
        rotation.append(rotation[-1] @ turn)
    return Frames(np.array(origin), np.array(rotation))


_ROUNDS = 30
_SETTLED_MM = 1e-9
_SAME = 1e-10


@dataclass(frozen=True)
class Setup:
    """Frame and tool of one mounting.

    ``rotation``, ``shift_mm`` (3, 3) or (3,): a point of the base in the instrument's frame is ``rotation @ point +
    shift_mm``.
    ``tool_mm`` (3,): the target in the flange's frame.
    """

    rotation: Floats
    shift_mm: Floats
    tool_mm: Floats

    def in_base(self, measured_mm: Floats) -> Floats:
        """Return measured points (n, 3) in the frame of the robot's base."""
        return (measured_mm - self.shift_mm) @ self.rotation


def fitted(at: Frames, measured_mm: Floats) -> Setup:
    """Return frame and tool that bring the commanded poses nearest to the measured points (n, 3).

    The frame for a given tool is exact, the tool for a given frame is linear; both together by
    Gauss-Newton from there.
    """
    tool = np.zeros(3)
    for _ in range(4):
        rotation, shift = rigid(at.tool_mm(tool), measured_mm)
        tool = _tool(at, (measured_mm - shift) @ rotation)
    for _ in range(_ROUNDS):
        rotation, shift = rigid(at.tool_mm(tool), measured_mm)
        left = (measured_mm - shift) @ rotation - at.tool_mm(tool)
        step = np.linalg.lstsq(columns(at, tool).reshape(-1, 9), left.ravel(), rcond=_SAME)[0][6:]
        tool = tool + step
        if np.abs(step).max() < _SETTLED_MM:
            break
    rotation, shift = rigid(at.tool_mm(tool), measured_mm)
    return Setup(rotation, shift, tool)


def columns(at: Frames, tool_mm: Floats) -> Floats:
    """Return what a unit of shift (mm), turn (rad) and tool (mm) does at the tool, shape (n, 3, 9)."""
    point = at.tool_mm(tool_mm)
    shift = np.broadcast_to(np.eye(3), (len(point), 3, 3))
    turn = np.stack([np.cross(axis, point) for axis in np.eye(3)], axis=2)
    return np.concatenate([shift, turn, at.rotation[-1]], axis=2)


def left_by_setup(design: Floats) -> Callable[[Floats], Floats]:
    """Return what takes from small errors (n, 3) that are added to a test what frame and tool, fitted again, take.

    ``design`` (n, 3, 9): as :func:`columns` gives it.
    """
    flat = design.reshape(-1, design.shape[2])
    basis, size, _ = np.linalg.svd(flat / np.linalg.norm(flat, axis=0), full_matrices=False)
    taken = basis[:, size > _SAME * size[0]]

    def left(added: Floats) -> Floats:
        return np.asarray(added - (taken @ (added.ravel() @ taken)).reshape(added.shape))

    return left


def rigid(points_mm: Floats, measured_mm: Floats) -> tuple[Floats, Floats]:
    """Return the rotation (3, 3) and shift (3,) that bring points nearest to measured ones."""
    here, there = points_mm.mean(axis=0), measured_mm.mean(axis=0)
    u, _, vt = np.linalg.svd((measured_mm - there).T @ (points_mm - here))
    rotation = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    return rotation, there - rotation @ here


def _tool(at: Frames, base_mm: Floats) -> Floats:
    inward = at.rotation[-1].transpose(0, 2, 1)
    return (inward @ (base_mm - at.origin_mm[-1])[:, :, None])[:, :, 0].mean(axis=0)
