"""Kinematics of a six-joint cobot and the geometry of circular paths.

Denavit-Hartenberg parameters as published by the manufacturer ("DH parameters for
calculations of kinematics and dynamics", Universal Robots). Lengths in millimetres,
angles in radians. The kernels work on one sample and allocate only their result.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeVar, cast

import numpy as np
from numba import njit

from dtwin.errors import InputError
from dtwin.schema import Floats, standard_plane
from dtwin.units import shown_number

_Function = TypeVar("_Function", bound=Callable[..., object])

_POSITION_TOLERANCE_MM = 1e-7
_LENGTH_SCALE_MM = 300.0


def kernel(function: _Function) -> _Function:
    """Compile ``function`` with numba, cached, with strict floating-point semantics."""
    return cast(_Function, njit(cache=True)(function))


def long_kernel(function: _Function) -> _Function:
    """Compile as :func:`kernel` what takes milliseconds: other threads run meanwhile."""
    return cast(_Function, njit(cache=True, nogil=True)(function))


@kernel
def _past_joint(q_rad: float, dh: Floats, rotation: Floats, position: Floats) -> None:
    """Carry a frame, rotation (3, 3) and position (3,), past one joint; ``dh`` is its row."""
    a, d, alpha = dh[0], dh[1], dh[2]
    c, s = np.cos(q_rad + dh[3]), np.sin(q_rad + dh[3])
    ca, sa = np.cos(alpha), np.sin(alpha)
    for i in range(3):
        x, y, z = rotation[i, 0], rotation[i, 1], rotation[i, 2]
        along = c * x + s * y
        across = c * y - s * x
        position[i] += a * along + d * z
        rotation[i, 0] = along
        rotation[i, 1] = ca * across + sa * z
        rotation[i, 2] = ca * z - sa * across


@kernel
def forward_kernel(q_rad: Floats, dh: Floats, tcp_mm: Floats) -> tuple[Floats, Floats]:
    """Return the tool centre point and the tool's rotation for one joint vector.

    ``q_rad``, shape (6,): joint angles.
    ``dh``, shape (6, 4): rows of length a and offset d in mm, twist alpha and zero offset theta in rad.
    ``tcp_mm``, shape (3,): tool centre point in the flange frame.
    Returns, shapes (3,) and (3, 3): position in mm and rotation matrix, both in the base frame.
    """
    rotation = np.eye(3)
    position = np.zeros(3)
    for j in range(6):
        _past_joint(q_rad[j], dh[j], rotation, position)
    for i in range(3):
        for k in range(3):
            position[i] += rotation[i, k] * tcp_mm[k]
    return position, rotation


@kernel
def jacobian_kernel(q_rad: Floats, dh: Floats, tcp_mm: Floats) -> Floats:
    """Return the geometric Jacobian of the tool centre point.

    Parameters are those of ``forward_kernel``.

    Returns, shape (6, 6): rows 0-2 in mm/rad (translation), rows 3-5 in rad/rad (rotation), base frame.
    """
    axes = np.zeros((6, 3))
    origins = np.zeros((6, 3))
    rotation = np.eye(3)
    position = np.zeros(3)
    for j in range(6):
        for i in range(3):
            axes[j, i] = rotation[i, 2]
            origins[j, i] = position[i]
        _past_joint(q_rad[j], dh[j], rotation, position)
    for i in range(3):
        for k in range(3):
            position[i] += rotation[i, k] * tcp_mm[k]
    jacobian = np.empty((6, 6))
    for j in range(6):
        r0 = position[0] - origins[j, 0]
        r1 = position[1] - origins[j, 1]
        r2 = position[2] - origins[j, 2]
        jacobian[0, j] = axes[j, 1] * r2 - axes[j, 2] * r1
        jacobian[1, j] = axes[j, 2] * r0 - axes[j, 0] * r2
        jacobian[2, j] = axes[j, 0] * r1 - axes[j, 1] * r0
        for i in range(3):
            jacobian[3 + i, j] = axes[j, i]
    return jacobian


@kernel
def _solve_kernel(matrix: Floats, right: Floats) -> Floats:
    """Solve a small dense linear system by elimination with row pivoting.

    Serving hosts have no LAPACK that numba could call.

    ``matrix``, (n, n): overwritten.
    ``right``, (n,): overwritten by the solution, which is also returned.
    """
    n = right.shape[0]
    for k in range(n):
        pivot = k
        for i in range(k + 1, n):
            if abs(matrix[i, k]) > abs(matrix[pivot, k]):
                pivot = i
        if pivot != k:
            for m in range(n):
                matrix[k, m], matrix[pivot, m] = matrix[pivot, m], matrix[k, m]
            right[k], right[pivot] = right[pivot], right[k]
        for i in range(k + 1, n):
            factor = matrix[i, k] / matrix[k, k]
            for m in range(k, n):
                matrix[i, m] -= factor * matrix[k, m]
            right[i] -= factor * right[k]
    for k in range(n - 1, -1, -1):
        for m in range(k + 1, n):
            right[k] -= matrix[k, m] * right[m]
        right[k] /= matrix[k, k]
    return right


@kernel
def inverse_kernel(
    position_mm: Floats, rotation: Floats, dh: Floats, tcp_mm: Floats, seed_q_rad: Floats
) -> tuple[Floats, float]:
    """Return the joint angles nearest to a seed that reach a pose, by damped Newton steps.

    ``position_mm``, ``rotation``, shapes (3,) and (3, 3): wanted tool centre point and rotation in the base frame.
    ``dh``, ``tcp_mm``: as in ``forward_kernel``.
    ``seed_q_rad``, shape (6,): start of the iteration; decides the joint branch.
    Returns, shape (6,): joint angles, and the pose error that is left (mm; rotation times 300 mm).
    """
    q = seed_q_rad.copy()
    error = np.empty(6)
    left = 1e300
    for _ in range(60):
        at, turned = forward_kernel(q, dh, tcp_mm)
        for i in range(3):
            error[i] = (position_mm[i] - at[i]) / _LENGTH_SCALE_MM
            error[3 + i] = 0.0
        for k in range(3):
            x, y, z = turned[0, k], turned[1, k], turned[2, k]
            u, v, w = rotation[0, k], rotation[1, k], rotation[2, k]
            error[3] += 0.5 * (y * w - z * v)
            error[4] += 0.5 * (z * u - x * w)
            error[5] += 0.5 * (x * v - y * u)
        squares = 0.0
        for i in range(6):
            squares += error[i] * error[i]
        left = np.sqrt(squares) * _LENGTH_SCALE_MM
        if left < _POSITION_TOLERANCE_MM:
            break
        jacobian = jacobian_kernel(q, dh, tcp_mm)
        for j in range(6):
            for i in range(3):
                jacobian[i, j] /= _LENGTH_SCALE_MM
        normal, right = np.zeros((6, 6)), np.zeros(6)
        for k in range(6):
            for i in range(6):
                right[i] += jacobian[k, i] * error[k]
                for m in range(6):
                    normal[i, m] += jacobian[k, i] * jacobian[k, m]
        damping = 1e-4 * min(1.0, squares) + 1e-15
        for i in range(6):
            normal[i, i] += damping
        step = _solve_kernel(normal, right)
        largest = 0.0
        for i in range(6):
            largest = max(largest, abs(step[i]))
        scale = min(1.0, 0.3 / largest) if largest > 0.0 else 1.0
        for i in range(6):
            q[i] += scale * step[i]
    return q, left


@kernel
def _forward_many(q_rad: Floats, dh: Floats, tcp_mm: Floats, positions: Floats, rotations: Floats) -> None:
    for n in range(q_rad.shape[0]):
        positions[n], rotations[n] = forward_kernel(q_rad[n], dh, tcp_mm)


@kernel
def _inverse_many(
    positions_mm: Floats, rotation: Floats, dh: Floats, tcp_mm: Floats, seed_q_rad: Floats
) -> tuple[Floats, float]:
    joints = np.empty((positions_mm.shape[0], 6))
    worst = 0.0
    q = seed_q_rad
    for n in range(positions_mm.shape[0]):
        q, left = inverse_kernel(positions_mm[n], rotation, dh, tcp_mm, q)
        joints[n] = q
        worst = max(worst, left)
    return joints, worst


def _published_ur10e() -> Floats:
    quarter = np.pi / 2
    return np.array(
        [
            [0.0, 180.7, quarter, 0.0],
            [-612.7, 0.0, 0.0, 0.0],
            [-571.55, 0.0, 0.0, 0.0],
            [0.0, 174.15, quarter, 0.0],
            [0.0, 119.85, -quarter, 0.0],
            [0.0, 116.55, 0.0, 0.0],
        ]
    )


@dataclass(frozen=True)
class KinematicChain:
    """Serial chain of six revolute joints.

    ``dh``, shape (6, 4): standard Denavit-Hartenberg rows: a_mm, d_mm, alpha_rad, theta_rad.
    """

    name: str
    dh: Floats = field(default_factory=_published_ur10e)

    def forward(self, q_rad: Floats, tcp_mm: Floats) -> tuple[Floats, Floats]:
        """Return position (3,) in mm and rotation (3, 3) of the tool for one joint vector."""
        return forward_kernel(q_rad, self.dh, tcp_mm)

    def forward_many(self, q_rad: Floats, tcp_mm: Floats) -> tuple[Floats, Floats]:
        """Return positions (n, 3) in mm and rotations (n, 3, 3) for joints of shape (n, 6)."""
        positions = np.empty((len(q_rad), 3))
        rotations = np.empty((len(q_rad), 3, 3))
        _forward_many(q_rad, self.dh, tcp_mm, positions, rotations)
        return positions, rotations

    def position_jacobian(self, q_rad: Floats, tcp_mm: Floats) -> Floats:
        """Return d(position)/d(joints), shape (3, 6), in mm/rad."""
        return jacobian_kernel(q_rad, self.dh, tcp_mm)[:3]

    def inverse(self, position_mm: Floats, rotation: Floats, tcp_mm: Floats, seed_q_rad: Floats) -> Floats:
        """Return joint angles (6,) that reach a pose, on the branch of the seed.

        Raises ``InputError`` when the pose is out of reach from this branch.
        """
        q_rad, left = inverse_kernel(position_mm, rotation, self.dh, tcp_mm, seed_q_rad)
        self._require_reached(left)
        return q_rad

    def inverse_many(self, positions_mm: Floats, rotation: Floats, tcp_mm: Floats, seed_q_rad: Floats) -> Floats:
        """Return joint angles (n, 6) along a path of constant rotation, each seeding the next.

        Raises ``InputError`` when a pose of the path is out of reach from this branch.
        """
        joints, worst = _inverse_many(positions_mm, rotation, self.dh, tcp_mm, seed_q_rad)
        self._require_reached(worst)
        return joints

    def _require_reached(self, left_mm: float) -> None:
        if not left_mm < 1e-3:
            raise InputError(
                f"{self.name} cannot reach this pose from the given joint branch",
                code="kinematics.unreachable",
                got=f"{shown_number(left_mm)} mm of pose error left",
                hint="move the circle's centre, or start from another joint branch",
            )


UR10E = KinematicChain("UR10e")


def plane_axes(plane: str) -> tuple[Floats, Floats]:
    """Return the base-frame unit vectors (3,) of a plane's first and second axis.

    Raises ``InputError`` when the plane is not XY, YZ or ZX, or one of these with its letters exchanged.
    """
    name, direction = standard_plane(plane, "CCW")
    first = np.eye(3)["XYZ".index(name[0])]
    second = np.eye(3)["XYZ".index(name[1])]
    return (first, second) if direction == "CCW" else (second, first)


def radial_unit(plane: str, angle_rad: Floats | float) -> Floats:
    """Return outward unit vectors of a circle, (..., 3), at angles (...,) from its plane's first axis to the second."""
    first, second = plane_axes(plane)
    angle = np.asarray(angle_rad, dtype=np.float64)[..., None]
    return np.cos(angle) * first + np.sin(angle) * second


def normal_unit(plane: str) -> Floats:
    """Return the unit vector (3,) that is normal to a plane."""
    return np.cross(*plane_axes(plane))
