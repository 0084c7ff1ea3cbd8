"""Serial chains of a robot, and what small errors of them do at the tool."""

from __future__ import annotations

from collections.abc import Mapping
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
