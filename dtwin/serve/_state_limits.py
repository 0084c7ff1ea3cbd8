"""What no machine's state can be: the largest magnitude of each of its numbers."""

from __future__ import annotations

import re

import numpy as np

from dtwin.features.compiled import compiled
from dtwin.kinematics import KinematicChain
from dtwin.links import layout
from dtwin.schema import Floats

_TURN_RAD = 2.0 * np.pi
_LARGEST = {
    "timestamp_s": 1e11,
    "q_rad": 6 * _TURN_RAD,
    "qd_rad_s": 100.0,
    "tcp_mm": 1e5,
    "speed_mm_s": 1e5,
    "speed_scaling": 10.0,
    "runtime_running": 1.0,
    "safety_ok": 1.0,
    "segment_id": 1e9,
    "segment_time_s": 1e9,
    "plane_id": 2.0,
    "centre_mm": 1e6,
    "radius_mm": 1e6,
    "direction_sign": 1.0,
    "feed_mm_min": 1e7,
    "applied_sequence": float(layout.SEQUENCE_LIMIT),
    "applied_um": 1e5,
}
"""By what is left of a number's name without ``target``, ``actual``, joint and axis. Poses of the
largest machine tools are within 100 m."""

_ROBOT = {"q_rad": 3 * _TURN_RAD, "qd_rad_s": 4 * _TURN_RAD, "speed_mm_s": 1e4}
"""Joints of an industrial robot end at one or two turns, and none turns four times a second."""


def any_machine() -> Floats:
    """Return the largest magnitudes (N,) in the state of whatever machine."""
    return _limits(_LARGEST)


def robot(chain: KinematicChain, tcp_mm: Floats) -> Floats:
    """Return the largest magnitudes (N,) in the state of a robot.

    ``chain``: its links: no pose is farther from the base than they are long together.
    ``tcp_mm`` (3,): tool centre point in the flange frame.
    """
    reach_mm = float(np.abs(chain.dh[:, :2]).sum() + np.linalg.norm(tcp_mm))
    return _limits(_LARGEST | _ROBOT | {"tcp_mm": reach_mm})


@compiled
def possible(state: Floats, largest: Floats) -> bool:
    """Tell whether a state (N,) is finite throughout and within its limits (N,)."""
    within = True
    for i in range(state.shape[0]):
        # Not a number compares false.
        within = within and abs(state[i]) <= largest[i]
    return within


def impossible(state: Floats, largest: Floats) -> str:
    """Return the name and value of the first number beyond its limit; empty when there is none."""
    wrong = np.flatnonzero(~(np.abs(state) <= largest))
    return f"{layout.NAMES[wrong[0]]} = {state[wrong[0]]:g}" if len(wrong) else ""


def _limits(largest: dict[str, float]) -> Floats:
    kinds = [re.sub(r"^(target|actual)_|_[1-6xyz](?=_)", "", name) for name in layout.NAMES]
    return np.array([largest[kind] for kind in kinds])
