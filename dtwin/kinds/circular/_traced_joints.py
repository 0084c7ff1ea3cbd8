"""Joints of a robot as inputs of an expression."""

from __future__ import annotations

from dataclasses import dataclass

from dtwin.serve.builder import GraphBuilder
from dtwin.train.traced import NotTraceable, Traced

_N_JOINTS = 6
# Wider than any robot moves: plane, radius and feed are what bounds the correction.
JOINT_RANGES: dict[str, tuple[float, float]] = {
    **{f"q{j}_rad": (-7.0, 7.0) for j in range(1, _N_JOINTS + 1)},
    **{f"qd{j}_rad_s": (-7.0, 7.0) for j in range(1, _N_JOINTS + 1)},
    **{f"lever_{j}_mm_rad": (-3000.0, 3000.0) for j in range(1, _N_JOINTS + 1)},
}


@dataclass(frozen=True)
class TracedJoints:
    """What effects of joints ask a state for.

    ``q_rad``, ``qd_rad_s``, ``lever_mm``: tables of one row: angle, speed, and change of the radius per radian of each
    joint.
    """

    q_rad: Traced
    qd_rad_s: Traced
    lever_mm: Traced

    @property
    def gravity_nmm(self) -> Traced:
        """Refuse: the path inputs do not hold moments."""
        raise NotTraceable("it needs the moments of the joints, which serving does not compute")


def traced_joints(builder: GraphBuilder, horizon_s: float) -> TracedJoints:
    """Return the joints where they will be when a correction takes effect."""
    numbers = range(1, _N_JOINTS + 1)
    speed = [builder.input(f"qd{j}_rad_s") for j in numbers]
    angle = [builder.input(f"q{j}_rad") for j in numbers]
    if horizon_s:
        angle = [q + horizon_s * qd for q, qd in zip(angle, speed, strict=True)]
    lever = [builder.input(f"lever_{j}_mm_rad") for j in numbers]
    return TracedJoints(Traced(angle, table=True), Traced(speed, table=True), Traced(lever, table=True))
