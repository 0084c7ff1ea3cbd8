"""Structural modes: oscillators shaken by the acceleration of the rigid arm."""

from __future__ import annotations

import numpy as np

from dtwin.kinematics import kernel
from dtwin.machines.parameters import StructureParameters
from dtwin.schema import Floats

_OMEGA, _DAMPING, _POSTURE, _REACH_MM, _FLANGE_SHARE, SHAPE, _DRIVEN, _JOLTED = (0, 1, 2, 3, 4, 5, 8, 9)
_COLUMNS = 10


def mode_table(parameters: StructureParameters) -> Floats:
    """Return the constants of the modes, shape (modes, 10).

    A mode obeys x'' + 2 z w x' + w^2 x = -s . (g a + h b), with shape s and participations g in the
    arm's acceleration a and h in the jolts b; w falls as the arm reaches out.

    Returns (modes, 10): angular frequency in rad/s, damping ratio, exponent of the posture and reach in mm at which the
    frequency holds, share seen at the flange, shape vector in the frame that turns with joint 1 (3), the two
    participations.
    """
    table = np.empty((len(parameters.frequency_hz), _COLUMNS))
    table[:, _OMEGA] = 2.0 * np.pi * np.array(parameters.frequency_hz)
    table[:, _DAMPING] = parameters.damping_ratio
    table[:, _POSTURE], table[:, _REACH_MM] = parameters.posture_1, parameters.posture_reach_mm
    table[:, _FLANGE_SHARE] = parameters.flange_share
    shape = np.array(parameters.shape)
    table[:, SHAPE:_DRIVEN] = shape / np.linalg.norm(shape, axis=1)[:, None]
    table[:, _DRIVEN], table[:, _JOLTED] = parameters.participation, parameters.jolt_participation
    return table


@kernel
def modes_kernel(
    modes: Floats,
    tick_s: float,
    joint1_rad: float,
    reach_mm: float,
    acceleration: Floats,
    jolt: Floats,
    state: Floats,
    tcp_mm: Floats,
    flange_mm: Floats,
) -> None:
    """Advance every mode by one tick and add its displacement to tool and flange.

    Force and frequency are held over the tick, so that the step is exact (zero-order hold).

    ``modes``, (modes, 10): from ``mode_table``.
    ``joint1_rad``: angle of joint 1, with which the mode shapes turn.
    ``reach_mm``: how far the tool is from the axis of joint 1.
    ``acceleration``, (3,): acceleration of the rigid arm at the tool, mm/s^2.
    ``jolt``, (3,): jolt of the drives, mm/s^2.
    ``state``, (2 * modes,): position and speed of each mode; updated.
    ``tcp_mm``, ``flange_mm``, (3,): points to displace; updated.
    """
    c, s = np.cos(joint1_rad), np.sin(joint1_rad)
    for m in range(modes.shape[0]):
        omega, damping = modes[m, _OMEGA], modes[m, _DAMPING]
        if modes[m, _POSTURE] != 0.0:
            omega *= (modes[m, _REACH_MM] / max(reach_mm, 1.0)) ** modes[m, _POSTURE]
        root = np.sqrt(1.0 - damping**2)
        decay = np.exp(-damping * omega * tick_s)
        cosine = decay * np.cos(root * omega * tick_s)
        sine = decay * np.sin(root * omega * tick_s)
        stay, coast = cosine + damping / root * sine, sine / (root * omega)
        pull, keep = -omega * sine / root, cosine - damping / root * sine
        x = c * modes[m, SHAPE] - s * modes[m, SHAPE + 1]
        y = s * modes[m, SHAPE] + c * modes[m, SHAPE + 1]
        z = modes[m, SHAPE + 2]
        driven, jolted = modes[m, _DRIVEN], modes[m, _JOLTED]
        push = x * (driven * acceleration[0] + jolted * jolt[0])
        push += y * (driven * acceleration[1] + jolted * jolt[1])
        push += z * (driven * acceleration[2] + jolted * jolt[2])
        held = -push / omega**2
        place, speed = state[2 * m] - held, state[2 * m + 1]
        moved = held + stay * place + coast * speed
        state[2 * m + 1] = pull * place + keep * speed
        state[2 * m] = moved
        share = modes[m, _FLANGE_SHARE] * moved
        tcp_mm[0] += x * moved
        tcp_mm[1] += y * moved
        tcp_mm[2] += z * moved
        flange_mm[0] += x * share
        flange_mm[1] += y * share
        flange_mm[2] += z * share
