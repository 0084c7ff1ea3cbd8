"""Structural modes: oscillators shaken by the acceleration of the rigid arm."""

from __future__ import annotations

import numpy as np

from dtwin.kinematics import kernel
from dtwin.machines.parameters import StructureParameters
from dtwin.schema import Floats

FLANGE_SHARE, SHAPE, DRIVEN, JOLTED = 6, 7, 10, 11
_COLUMNS = 12


def mode_table(parameters: StructureParameters, tick_s: float) -> Floats:
    """Return the exactly discretised modes, shape (modes, 12).

    A mode obeys x'' + 2 z w x' + w^2 x = -s . (g a + h b), with shape s and
    participations g in the arm's acceleration a and h in the jolts b, which are held over a tick, so that the transition matrix is exact (textbook zero-order hold).

    Parameters
    ----------
    parameters : StructureParameters
        Frequencies, damping, shapes.
    tick_s : float
        Period of the controller.

    Returns
    -------
    ndarray, shape (modes, 12)
        Transition matrix by rows (4), forcing of position and speed (2), share seen at the
        flange, shape vector in the frame that turns with joint 1 (3), the two participations.
    """
    table = np.empty((len(parameters.frequency_hz), _COLUMNS))
    for row, hz, damping, shape, participation, jolted, share in zip(
        table,
        parameters.frequency_hz,
        parameters.damping_ratio,
        parameters.shape,
        parameters.participation,
        parameters.jolt_participation,
        parameters.flange_share,
        strict=True,
    ):
        omega = 2.0 * np.pi * hz
        damped = omega * np.sqrt(1.0 - damping**2)
        decay = np.exp(-damping * omega * tick_s)
        c, s = decay * np.cos(damped * tick_s), decay * np.sin(damped * tick_s)
        ratio = damping * omega / damped
        row[0:2] = c + ratio * s, s / damped
        row[2:4] = -(omega**2) * s / damped, c - ratio * s
        row[4] = -(1.0 - row[0]) / omega**2
        row[5] = row[2] / omega**2
        row[FLANGE_SHARE] = share
        row[SHAPE : SHAPE + 3] = np.array(shape) / np.linalg.norm(shape)
        row[DRIVEN:] = participation, jolted
    return table


@kernel
def modes_kernel(
    modes: Floats,
    joint1_rad: float,
    acceleration: Floats,
    jolt: Floats,
    state: Floats,
    tcp_mm: Floats,
    flange_mm: Floats,
) -> None:
    """Advance every mode by one tick and add its displacement to tool and flange.

    Parameters
    ----------
    modes : ndarray, shape (modes, 12)
        From ``mode_table``.
    joint1_rad : float
        Angle of joint 1, with which the mode shapes turn.
    acceleration : ndarray, shape (3,)
        Acceleration of the rigid arm at the tool, mm/s^2.
    jolt : ndarray, shape (3,)
        Jolt of the drives, mm/s^2.
    state : ndarray, shape (2 * modes,)
        Position and speed of each mode; updated.
    tcp_mm, flange_mm : ndarray, shape (3,)
        Points to displace; updated.
    """
    c, s = np.cos(joint1_rad), np.sin(joint1_rad)
    for m in range(modes.shape[0]):
        x = c * modes[m, SHAPE] - s * modes[m, SHAPE + 1]
        y = s * modes[m, SHAPE] + c * modes[m, SHAPE + 1]
        z = modes[m, SHAPE + 2]
        driven, jolted = modes[m, DRIVEN], modes[m, JOLTED]
        push = x * (driven * acceleration[0] + jolted * jolt[0])
        push += y * (driven * acceleration[1] + jolted * jolt[1])
        push += z * (driven * acceleration[2] + jolted * jolt[2])
        place, speed = state[2 * m], state[2 * m + 1]
        moved = modes[m, 0] * place + modes[m, 1] * speed + modes[m, 4] * push
        state[2 * m + 1] = modes[m, 2] * place + modes[m, 3] * speed + modes[m, 5] * push
        state[2 * m] = moved
        share = modes[m, FLANGE_SHARE] * moved
        tcp_mm[0] += x * moved
        tcp_mm[1] += y * moved
        tcp_mm[2] += z * moved
        flange_mm[0] += x * share
        flange_mm[1] += y * share
        flange_mm[2] += z * share
