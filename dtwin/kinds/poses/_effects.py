"""Effects of a robot arm: what a unit of each does at the tool.

All are small turns or shifts within the chain, so that the error of the tool is linear in them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dtwin.errors import InputError
from dtwin.kinds.poses._chain import Frames
from dtwin.schema import Floats

_STILL_RAD = 1e-5


@dataclass(frozen=True)
class Poses:
    """Poses of a campaign that were measured.

    ``joints_rad`` (n, joints): commanded.
    ``measured_mm`` (n, 3): in the instrument's frame.
    ``ambient_c`` (n,) or None: temperature beside the robot.
    ``place`` (n,): number of the commanded pose: repeats share it.
    ``t_s`` (n,) or None: when it was measured.
    """

    joints_rad: Floats
    measured_mm: Floats
    at: Frames
    ambient_c: Floats | None
    place: Floats
    t_s: Floats | None = None


@dataclass(frozen=True)
class _Effect:
    """One cause. ``per`` is ``joint`` or ``robot``; ``needs``: what a table must have for it.
    ``group``: of what it is on pages.

    ``of_campaign``: belongs to the set-up or the day, and to no other test of the robot.
    ``cause``, ``elsewhere``: where tests of a path measure the same: their name of it, name and unit of the parameter there, and
    how many of its unit one of this unit is.
    """

    name: str
    title: str
    per: str
    parameters: tuple[tuple[str, str], ...]
    columns: Callable[[Poses, Floats, int], Floats]
    remedy: str
    needs: str = ""
    of_campaign: bool = False
    cause: str = ""
    elsewhere: tuple[str, str, float] | None = None
    group: str = "geometry"

    def named(self, number: int) -> tuple[str, str, float]:
        """Return name and unit of a parameter as other tests know them, and how many of that unit one of this unit is."""
        return self.elsewhere or (*self.parameters[number], 1.0)


@dataclass(frozen=True)
class Term:
    """An effect at a joint, counted from 1; 0 for the whole robot."""

    effect: str
    joint: int = 0

    @property
    def axis(self) -> str:
        """The joint as it is written."""
        return f"J{self.joint}" if self.joint else ""

    @property
    def label(self) -> str:
        """As a user writes it."""
        return f"{self.effect}@{self.axis}" if self.joint else self.effect


def family_label(terms: Sequence[Term]) -> str:
    """Return terms of one effect as a user writes them: ``joint_zero@J2+J3``."""
    joints = "+".join(term.axis for term in terms if term.joint)
    return f"{terms[0].effect}@{joints}" if joints else terms[0].effect


def _about(poses: Poses, point: Floats, joint: int) -> Floats:
    """Return what a turn of a joint by 1 rad does, shape (n, 3)."""
    return np.cross(poses.at.rotation[joint - 1][:, :, 2], point - poses.at.origin_mm[joint - 1])


def _zero(poses: Poses, point: Floats, joint: int) -> Floats:
    return _about(poses, point, joint)[:, :, None] * 1e-3


def _geometry(poses: Poses, point: Floats, joint: int) -> Floats:
    at = poses.at
    along, arm = at.rotation[joint], point - at.origin_mm[joint]
    x, y = along[:, :, 0], along[:, :, 1]
    turns = [np.cross(x, arm) * 1e-3, np.cross(y, arm) * 1e-3]
    return np.stack([x, at.rotation[joint - 1][:, :, 2], *turns], axis=2)


def _sag(poses: Poses, point: Floats, joint: int) -> Floats:
    """Return what compliance times the moment of a mass at every later joint does, per metre of lever."""
    at = poses.at
    turn, axis = _about(poses, point, joint), at.rotation[joint - 1][:, :, 2]
    levers = []
    for mass in range(joint, len(at.origin_mm) - 2):
        arm = at.origin_mm[mass] - at.origin_mm[joint - 1]
        if np.linalg.norm(arm, axis=1).max() > 200.0:
            levers.append(np.cross(arm, [0.0, 0.0, -1.0]))
    if not levers:
        levers = [np.cross(point - at.origin_mm[joint - 1], [0.0, 0.0, -1.0])]
    # Masses past the elbow lie near one line: the elbow and the wrist stand for all of them.
    kept = [levers[0], levers[-1]] if len(levers) > 1 else levers
    return np.stack([turn * ((lever * axis).sum(axis=1) * 1e-6)[:, None] for lever in kept], axis=2)


def _cyclic(order: float) -> Callable[[Poses, Floats, int], Floats]:
    def columns(poses: Poses, point: Floats, joint: int) -> Floats:
        turn, angle = _about(poses, point, joint) * 1e-3, order * poses.joints_rad[:, joint - 1]
        return np.stack([turn * np.cos(angle)[:, None], turn * np.sin(angle)[:, None]], axis=2)

    return columns


def _reversal(poses: Poses, point: Floats, joint: int) -> Floats:
    came = np.diff(poses.joints_rad[:, joint - 1], prepend=poses.joints_rad[:1, joint - 1])
    side = np.where(np.abs(came) > _STILL_RAD, np.sign(came), 0.0)
    # A joint that stood keeps the side from which it came; it stays behind.
    last = np.maximum.accumulate(np.where(side != 0.0, np.arange(len(side)), 0))
    return _about(poses, point, joint)[:, :, None] * (-0.5e-3 * side[last])[:, None, None]


def _growth(poses: Poses, point: Floats, joint: int) -> Floats:
    warm = poses.ambient_c
    rise = np.zeros(len(point)) if warm is None else warm - warm.mean()
    return (point * rise[:, None] * 1e-6)[:, :, None]


def _setup_drift(poses: Poses, point: Floats, joint: int) -> Floats:
    if poses.t_s is None:
        return np.zeros((len(point), 3, 3))
    hours = (poses.t_s - poses.t_s.mean()) / 3600.0
    return np.asarray(hours[:, None, None] * np.eye(3))


_ANGLE = (("cosine", "mrad"), ("sine", "mrad"))
_GEOMETRY = (("length", "mm"), ("offset", "mm"), ("twist", "mrad"), ("tilt", "mrad"))
_EFFECTS = (
    _Effect(
        "joint_zero",
        "zero of a joint",
        "joint",
        (("offset", "mrad"),),
        _zero,
        "set the joint's zero anew",
        cause="joint_offset",
        elsewhere=("offset", "urad", 1e3),
    ),
    _Effect("link_geometry", "length and twist of a link", "joint", _GEOMETRY, _geometry, "correct the DH table"),
    _Effect(
        "gravity_sag",
        "gravity sag of a loaded joint",
        "joint",
        (("near", "mrad/m"), ("far", "mrad/m")),
        _sag,
        "state the payload; correct the joint by compliance times moment",
    ),
    _Effect(
        "joint_cyclic_1", "once a turn of a joint", "joint", _ANGLE, _cyclic(1.0), "encoder off centre", group="drive"
    ),
    _Effect(
        "joint_cyclic_2",
        "twice a turn of a joint",
        "joint",
        _ANGLE,
        _cyclic(2.0),
        "gear or encoder disc not round",
        group="drive",
    ),
    _Effect("joint_cyclic_3", "three times a turn of a joint", "joint", _ANGLE, _cyclic(3.0), "gear", group="drive"),
    _Effect(
        "joint_reversal",
        "lost motion of a joint",
        "joint",
        (("lost", "mrad"),),
        _reversal,
        "approach from one side",
        elsewhere=("backlash", "urad", 1e3),
        group="drive",
    ),
    _Effect(
        "ambient_growth",
        "growth with the ambient",
        "robot",
        (("rate", "um/(m K)"),),
        _growth,
        "let it settle",
        "ambient_c, by which the temperature changes by more than 0.5 K",
        cause="thermal_growth",
        elsewhere=("expansion", "um/(m K)", 1.0),
        group="heat",
    ),
    _Effect(
        "setup_drift",
        "the robot's base or the instrument moves while it is measured",
        "robot",
        (("x", "mm/h"), ("y", "mm/h"), ("z", "mm/h")),
        _setup_drift,
        "let robot and instrument warm up; measure a fixed target now and then",
        "t_s, the times of the rows",
        of_campaign=True,
        group="instrument",
    ),
)
EFFECTS: Mapping[str, _Effect] = {effect.name: effect for effect in _EFFECTS}


def carrying(joints: int) -> int:
    """Return how many joints sag: those up to the elbow, which is the fourth of seven; a wrist carries little."""
    return (joints + 1) // 2


def library(joints: int, *, ambient: bool, timed: bool = False) -> list[Term]:
    """Return every term that a robot of so many joints can have."""
    out = [
        Term(e.name, j)
        for e in EFFECTS.values()
        if e.per == "joint"
        for j in range(1, (carrying(joints) if e.name == "gravity_sag" else joints) + 1)
    ]
    return [*out, *([Term("ambient_growth")] if ambient else []), *([Term("setup_drift")] if timed else [])]


def terms_of(names: list[str] | tuple[str, ...], joints: int) -> tuple[Term, ...]:
    """Return the terms of names such as ``joint_zero`` (all joints), ``joint_zero@J2`` or ``joint_zero@J2+J3``.

    Raises ``InputError`` when there is no such effect or joint.
    """
    ordered: dict[Term, None] = {}
    for name in names:
        effect, _, at = name.partition("@")
        known = EFFECTS.get(effect)
        most = 0 if known is None or known.per != "joint" else carrying(joints) if effect == "gravity_sag" else joints
        allowed = {f"J{j}": j for j in range(1, most + 1)}
        wanted = at.split("+") if at else []
        if known is None or not set(wanted) <= set(allowed):
            raise InputError(
                "unknown effect of a robot arm",
                code="effect.unknown",
                got=name[:60],
                allowed=f"{effect} of {', '.join(allowed)}"
                if allowed
                else f"{', '.join(EFFECTS)}; of one joint: joint_zero@J2",
            )
        joints_of = [allowed[joint] for joint in wanted] or list(allowed.values()) or [0]
        ordered |= dict.fromkeys(Term(effect, j) for j in joints_of)
    return tuple(ordered)
