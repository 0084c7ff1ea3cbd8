"""A radial number becomes a vector along the radius, in every plane."""

from __future__ import annotations

import numpy as np
import pytest

from dtwin import kinematics
from dtwin.serve.direction import Direction
from dtwin.serve.interface import Output

PLANES = ("XY", "YZ", "ZX")


@pytest.mark.parametrize("plane", PLANES)
@pytest.mark.parametrize("angle", [0.0, 0.7, 2.0, -2.5, 9.0])
def test_correction_cancels_a_radial_error(plane: str, angle: float) -> None:
    error_um = 17.0
    error = error_um * kinematics.radial_unit(plane, angle)
    direction = Direction((Output("e", "path_radial", "error"),))
    correction = direction.apply(np.array([error_um]), angle, PLANES.index(plane))
    np.testing.assert_allclose(error + correction, 0.0, atol=1e-12)


@pytest.mark.parametrize("plane", PLANES)
@pytest.mark.parametrize("angle", [0.3, 2.0, -2.5])
def test_tangential_and_normal_axes(plane: str, angle: float) -> None:
    outputs = tuple(Output(f, f, "correction") for f in ("path_tangential", "path_normal"))
    found = Direction(outputs).apply(np.array([3.0, 5.0]), angle, PLANES.index(plane))
    normal = kinematics.normal_unit(plane)
    expected = 3.0 * np.cross(normal, kinematics.radial_unit(plane, angle)) + 5.0 * normal
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_base_axes_and_roles() -> None:
    outputs = (Output("x", "base_x", "error"), Output("y", "base_y", "correction"), Output("z", "base_z", "error"))
    assert Direction(outputs).apply(np.array([1.0, 2.0, 3.0]), 0.0, 0.0).tolist() == [-1, 2, -3]


def test_a_constant_radial_error_is_not_a_shift_of_the_centre() -> None:
    direction = Direction((Output("e", "path_radial"),))
    angles = np.linspace(0, 2 * np.pi, 360, endpoint=False)
    vectors = np.array([direction.apply(np.array([10.0]), a, 0.0).copy() for a in angles])
    np.testing.assert_allclose(vectors.mean(axis=0), 0.0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 10.0)


def radial_rms_after(swap: bool, flip: bool) -> float:
    """Residual of a made error after a correction with exchanged axes or sign."""
    angles = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    error_um = 20 * np.cos(2 * angles) + 8 * np.sin(3 * angles) + 5 * np.sin(angles)
    direction = Direction((Output("e", "path_radial"),))
    left = []
    for angle, e in zip(angles, error_um, strict=True):
        c = direction.apply(np.array([e]), angle, 0.0).copy()
        if swap:
            c[[0, 1]] = c[[1, 0]]
        if flip:
            c = -c
        left.append(e + c @ kinematics.radial_unit("XY", angle))
    return float(np.std(left))


def test_exchanged_axes_or_a_wrong_sign_would_be_seen() -> None:
    assert radial_rms_after(swap=False, flip=False) < 1e-9
    assert radial_rms_after(swap=True, flip=False) > 5.0
    assert radial_rms_after(swap=False, flip=True) > 25.0


def test_unknown_plane_is_not_a_number() -> None:
    direction = Direction((Output("e", "path_radial"),))
    for plane in (3.0, -1.0, 0.5, np.nan):
        assert np.isnan(direction.apply(np.array([1.0]), 0.0, plane)).all()
