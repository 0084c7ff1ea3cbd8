"""Orientations of poses, as quaternions, vectors, angles or matrices: checked, and kept as quaternions where they are commanded.

``target_qx_1 … target_qw_1`` are a unit quaternion; ``target_rotvec_x_deg …`` an axis times the angle about it; ``target_roll_deg``,
``target_pitch_deg``, ``target_yaw_deg`` turns about the fixed x, then y, then z axis; ``target_m11_1 … target_m33_1`` the rotation of a matrix of 3 or 4 rows, whose last column,
``target_m14_mm``, ``target_m24_mm``, ``target_m34_mm``, is the position. ``measured_…`` the same.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dtwin.errors import InputError
from dtwin.schema import Finding, Floats

QUATERNION = ("qx", "qy", "qz", "qw")
_ROTATION = tuple(f"m{row}{column}" for row in "123" for column in "123")
_BOTTOM = ("m41", "m42", "m43", "m44")
_POSITION = {"m14": "x", "m24": "y", "m34": "z"}
_VECTOR = ("rotvec_x", "rotvec_y", "rotvec_z")
_ANGLES = ("roll", "pitch", "yaw")
_ASK = (
    "target_rotvec_x_rad … where they are an axis times an angle (rx, ry, rz of UR); target_roll_deg, target_pitch_deg, target_yaw_deg where they are "
    "turns about fixed x, then y, then z (roll pitch yaw of ROS, W P R of Fanuc, C B A of KUKA)"
)
_TURNED = re.compile(r"(target|measured)_(r[xyz]|[abcwpr]|alpha|beta|gamma|roll|pitch|yaw|rotvec_[xyz])(_deg)?")
_MOST_DEG = 400.0
_UNITLESS = re.compile(rf"(target|measured)_({'|'.join((*QUATERNION, *_ROTATION, *_BOTTOM))})")
# Of what was rounded to three digits.
_OFF = 0.01


def house_name(name: str) -> str:
    """Return the house's name of a column: numbers of an orientation have no unit, and the last column of a matrix is a position."""
    if _UNITLESS.fullmatch(name):
        return f"{name}_1"
    what, _, rest = name.partition("_")
    place, _, unit = rest.partition("_")
    return f"{what}_{_POSITION[place]}_{unit}" if what in ("target", "measured") and place in _POSITION else name


def with_orientation(columns: dict[str, Floats], path: Path) -> tuple[dict[str, Floats], list[Finding]]:
    """Return columns whose commanded orientations are unit quaternions, and without those that were measured, which is said.

    Raises ``InputError`` when numbers are missing, or are no rotation.
    """
    known = re.compile(
        rf"(target|measured)_([xyz]_mm|({'|'.join((*QUATERNION, *_ROTATION, *_BOTTOM))})_1|({'|'.join((*_VECTOR, *_ANGLES))})_deg)"
    )
    unused = [name for name in columns if name.startswith(("target_", "measured_")) and not known.fullmatch(name)]
    out, findings = dict(columns), list[Finding]()
    if unused:
        commanded = any(name.startswith("target_") and _TURNED.fullmatch(name) for name in unused)
        told = "target_qx … target_qw, or target_m11 … target_m33"
        said = (
            f"{', '.join(unused)[:80]}: not used; an orientation is told as {told}{f'; or {_ASK}' if commanded else ''}"
        )
        findings.append(Finding("poses.orientation", "warning" if commanded else "info", said))
    for what in ("target", "measured"):
        parts = {name: out.pop(f"{what}_{name}_1", None) for name in (*QUATERNION, *_ROTATION, *_BOTTOM)}
        there = {name: values for name, values in parts.items() if values is not None}
        turned = {name: out.pop(f"{what}_{name}_deg", None) for name in (*_VECTOR, *_ANGLES)}
        angles = {name: values for name, values in turned.items() if values is not None}
        if not there and not angles:
            continue
        if not there:
            quaternion = _of_angles(angles, what, path)
        elif set(QUATERNION) & set(there):
            quaternion = _unit(_stacked(there, QUATERNION, what, path), what, path)
        else:
            quaternion = _of_matrix(there, what, path)
        if what == "measured":
            said = "measured orientations are not used: the figures are of positions"
            findings.append(Finding("poses.orientation", "info", said))
        else:
            out |= {f"{what}_{name}_1": quaternion[:, n] for n, name in enumerate(QUATERNION)}
    return out, findings


def _stacked(there: dict[str, Floats], names: tuple[str, ...], what: str, path: Path) -> Floats:
    missing = [name for name in names if name not in there]
    if missing:
        raise InputError(
            "an orientation lacks numbers",
            code="poses.orientation",
            where=str(path),
            got=", ".join(f"{what}_{name}" for name in there),
            allowed=", ".join(f"{what}_{name}" for name in names),
        )
    return np.stack([there[name] for name in names], axis=1)


def _unit(quaternion: Floats, what: str, path: Path) -> Floats:
    norm = np.linalg.norm(quaternion, axis=1)
    _require(np.abs(norm - 1.0) > _OFF, f"a length of {{:g}} of {what}_qx … {what}_qw", norm, path)
    return quaternion / norm[:, None]


def _of_angles(there: dict[str, Floats], what: str, path: Path) -> Floats:
    """Return the quaternions of vectors or of angles, in degrees."""
    names = _VECTOR if set(_VECTOR) & set(there) else _ANGLES
    degrees = _stacked(there, names, what, path)
    size = np.linalg.norm(degrees, axis=1) if names is _VECTOR else np.abs(degrees).max(axis=1)
    _require(
        size > _MOST_DEG, f"an angle of {{:z.0f}}° in {what}_{names[0]} …: degrees in columns of radians", size, path
    )
    good = np.isfinite(size)
    out = np.full((len(size), 4), np.nan)
    if good.any():
        radians = np.radians(degrees[good])
        turned = Rotation.from_rotvec(radians) if names is _VECTOR else Rotation.from_euler("xyz", radians)
        out[good] = turned.as_quat()
    return out


def _of_matrix(there: dict[str, Floats], what: str, path: Path) -> Floats:
    matrix = _stacked(there, _ROTATION, what, path).reshape(-1, 3, 3)
    bottom = [there[name] for name in _BOTTOM if name in there]
    low = np.abs(np.stack(bottom[:3], axis=1)).max(axis=1) if len(bottom) == len(_BOTTOM) else np.zeros(len(matrix))
    _require(low > _OFF, f"{{:g}} in {what}_m41 … {what}_m43: rows and columns are exchanged", low, path)
    off = np.abs(matrix @ matrix.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    off = np.where(np.linalg.det(np.nan_to_num(matrix)) < 0.0, 2.0, off)
    _require(off > _OFF, f"{what}_m11 … {what}_m33 off a right-handed rotation by {{:.3g}}", off, path)
    good = np.isfinite(off)
    out = np.full((len(matrix), 4), np.nan)
    out[good] = Rotation.from_matrix(matrix[good]).as_quat()
    return out


def _require(bad: NDArray[np.bool_], got: str, values: Floats, path: Path) -> None:
    rows = np.flatnonzero(bad)
    if rows.size:
        raise InputError(
            "an orientation is no rotation",
            code="poses.orientation",
            where=f"{path} pose {rows[0] + 1}",
            got=got.format(values[rows[0]]),
            allowed="quaternions of length 1; vectors and angles of 400° at most; matrices [m11 m12 m13 m14; m21 …] of a rotation and a position",
            hint="is each column named by its own number, and the scalar of the quaternion qw, and the unit of angles right?",
        )
