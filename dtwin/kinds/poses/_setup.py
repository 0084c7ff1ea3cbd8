"""Where the instrument stands and where its target sits on the flange: set-up, always fitted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dtwin.kinds.poses._chain import Frames
from dtwin.schema import Floats

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
