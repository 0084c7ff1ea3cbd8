"""Forward, inverse and differential kinematics of the UR10e."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from dtwin import kinematics
from dtwin.errors import InputError
from dtwin.kinematics import UR10E

TCP_MM = np.array([0.0, 0.0, 158.3])
SEED_RAD = np.array([0.2, -1.9, 2.1, -1.77, -1.57, 0.3])


def homogeneous_position_mm(q_rad: np.ndarray, tcp_mm: np.ndarray) -> np.ndarray:
    """Chain of 4 x 4 matrices, written another way than the kernel."""
    pose = np.eye(4)
    for angle, (a, d, alpha, offset) in zip(q_rad, UR10E.dh, strict=True):
        theta = angle + offset
        turn = np.eye(4)
        turn[:2, :2] = [[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]]
        shift = np.eye(4)
        shift[:3, 3] = [a, 0.0, d]
        twist = np.eye(4)
        twist[1:3, 1:3] = [[np.cos(alpha), -np.sin(alpha)], [np.sin(alpha), np.cos(alpha)]]
        pose = pose @ turn @ shift @ twist
    return np.asarray((pose @ np.append(tcp_mm, 1.0))[:3])


def test_zero_pose_is_the_published_one() -> None:
    position, _ = kinematics.UR10E.forward(np.zeros(6), np.zeros(3))
    np.testing.assert_allclose(position, [-1184.25, -290.7, 60.85], atol=1e-9)


@pytest.mark.parametrize("trial", range(5))
def test_forward_agrees_with_homogeneous_matrices(trial: int) -> None:
    q = np.random.default_rng(trial).uniform(-3, 3, 6)
    position, rotation = kinematics.UR10E.forward(q, TCP_MM)
    np.testing.assert_allclose(position, homogeneous_position_mm(q, TCP_MM), atol=1e-9)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)


def test_jacobian_is_the_derivative_of_position() -> None:
    step = 1e-6
    numeric = np.empty((3, 6))
    for j in range(6):
        shift = step * np.eye(6)[j]
        ahead, _ = kinematics.UR10E.forward(SEED_RAD + shift, TCP_MM)
        behind, _ = kinematics.UR10E.forward(SEED_RAD - shift, TCP_MM)
        numeric[:, j] = (ahead - behind) / (2 * step)
    np.testing.assert_allclose(kinematics.UR10E.position_jacobian(SEED_RAD, TCP_MM), numeric, rtol=1e-6, atol=1e-4)


@pytest.mark.parametrize("trial", range(5))
def test_inverse_returns_to_the_pose_on_the_branch_of_the_seed(trial: int) -> None:
    goal = SEED_RAD + np.random.default_rng(trial).uniform(-0.25, 0.25, 6)
    position, rotation = kinematics.UR10E.forward(goal, TCP_MM)
    found = kinematics.UR10E.inverse(position, rotation, TCP_MM, SEED_RAD)
    np.testing.assert_allclose(found, goal, atol=1e-8)


def test_path_is_inverted_sample_by_sample() -> None:
    joints = SEED_RAD + 0.1 * np.sin(np.linspace(0, 3, 40))[:, None] * np.array([1, 0, 0, 0, 0, 1])
    positions, rotations = UR10E.forward_many(joints, TCP_MM)
    back = UR10E.inverse_many(positions, rotations[0], TCP_MM, SEED_RAD)
    reached, turned = UR10E.forward_many(back, TCP_MM)
    np.testing.assert_allclose(reached, positions, atol=1e-6)
    np.testing.assert_allclose(turned, np.broadcast_to(rotations[0], turned.shape), atol=1e-8)


def test_unreachable_pose_is_refused() -> None:
    with pytest.raises(InputError) as caught:
        kinematics.UR10E.inverse(np.array([2000.0, 0.0, 0.0]), np.eye(3), TCP_MM, SEED_RAD)
    assert caught.value.code == "kinematics.unreachable"


def test_needs_no_scipy() -> None:
    code = """
import sys
sys.modules["scipy"] = None
import numpy as np
from dtwin import kinematics
q = np.array([0.2, -1.9, 2.1, -1.77, -1.57, 0.3])
position, rotation = kinematics.UR10E.forward(q, np.zeros(3))
raw = kinematics.inverse_kernel.py_func
from numba import njit
fresh = njit(raw)
found, left = fresh(position, rotation, kinematics.UR10E.dh, np.zeros(3), q + 0.1)
assert np.allclose(found, q) and left < 1e-6
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(("plane", "first", "second"), [("XY", 0, 1), ("YZ", 1, 2), ("ZX", 2, 0), ("XZ", 0, 2)])
def test_plane_geometry(plane: str, first: int, second: int) -> None:
    a, b = kinematics.plane_axes(plane)
    assert (a[first], b[second]) == (1.0, 1.0)
    angle = np.linspace(0, 6, 7)
    radial = kinematics.radial_unit(plane, angle)
    np.testing.assert_allclose(radial[0], a, atol=1e-15)
    np.testing.assert_allclose(kinematics.normal_unit(plane), np.cross(a, b))
    np.testing.assert_allclose(radial @ kinematics.normal_unit(plane), 0, atol=1e-15)
