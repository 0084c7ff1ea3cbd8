"""Joint errors: what the link does when the encoder side is asked for an angle; modes of the structure that the arm shakes.

Each joint has lost motion (a play operator), a strain-wave gear whose transmission error
depends on the tooth flank that carries the load and swells with load and with the turn of its
flexspline, friction that disturbs the position loop at reversals, and a gear spring that winds up
under the weight of the links: softer about zero torque, and with hysteresis.
"""

from __future__ import annotations

import numpy as np

from dtwin.kinematics import kernel
from dtwin.machines.parameters import JointParameters, StructureParameters
from dtwin.schema import Floats

PLAY_WIDTH, FRICTION, FRICTION_WIDTH, FRICTION_RECOVERY, COMPLIANCE = range(5)
FLEXSPLINE, TURNED, LOAD, LOAD_NM, SOFT, HYSTERESIS_NM, GEAR_FROM = range(5, 12)
_AMPLITUDE, _PHASE_FORWARD, _PHASE_REVERSE = range(3)
# The kernels' own names, so that numba sees plain integers.
_COMPLIANCE, _FLEXSPLINE, _TURNED, _LOAD = COMPLIANCE, FLEXSPLINE, TURNED, LOAD
_LOAD_NM, _SOFT, _GEAR_FROM = LOAD_NM, SOFT, GEAR_FROM
_GRAVITY_M_S2 = 9.80665
_URAD = 1e-6


def joint_table(parameters: JointParameters) -> Floats:
    """Return the constants of the six joints, shape (6, 12), in rad, s, N*m and rad/(N*m)."""
    table = np.empty((6, 12))
    table[:, PLAY_WIDTH] = np.array(parameters.play_width_urad) * _URAD
    table[:, FRICTION] = np.array(parameters.friction_urad) * _URAD
    table[:, FRICTION_WIDTH] = parameters.friction_width_urad * _URAD
    table[:, FRICTION_RECOVERY] = parameters.friction_recovery_s
    table[:, COMPLIANCE] = np.array(parameters.compliance_urad_nm) * _URAD
    table[:, FLEXSPLINE] = parameters.flexspline_1
    # Where the flexsplines are thickest: assembled without regard to it.
    table[:, TURNED] = 2.4 * np.arange(6)
    table[:, LOAD], table[:, LOAD_NM] = parameters.load_1, parameters.load_nm
    table[:, SOFT], table[:, HYSTERESIS_NM] = parameters.soft_1, parameters.hysteresis_nm
    table[:, GEAR_FROM] = parameters.flank_orders_from
    return table


def transmission_table(parameters: JointParameters, rng: np.random.Generator) -> Floats:
    """Return amplitude and the phases on both flanks, shape (6, orders, 3), in rad.

    Orders of bearing and encoder eccentricity have one phase, whatever flank is loaded;
    the orders of the gear have a phase per flank.
    """
    orders = np.array(parameters.orders_per_turn)
    table = np.empty((6, len(orders), 3))
    table[:, :, _AMPLITUDE] = np.array(parameters.order_amplitude_urad) * _URAD
    table[:, :, _PHASE_FORWARD:] = rng.uniform(0.0, 2.0 * np.pi, (6, len(orders), 2))
    shared = orders < parameters.flank_orders_from
    table[:, shared, _PHASE_REVERSE] = table[:, shared, _PHASE_FORWARD]
    return table


@kernel
def gravity_torque_kernel(q_rad: Floats, dh: Floats, mass_kg: Floats, torque_nm: Floats) -> None:
    """Write the weight's torque on shoulder and elbow, by static balance of point masses.

    ``q_rad``, (6,): joint angles.
    ``dh``, (6, 4): denavit-Hartenberg rows; the two arm lengths are used.
    ``mass_kg``, (3,): upper arm, forearm, and everything beyond the wrist.
    ``torque_nm``, (6,): receives the torques; only entries 1 and 2 change.
    """
    upper_m = 1e-3 * dh[1, 0] * np.cos(q_rad[1])
    fore_m = 1e-3 * dh[2, 0] * np.cos(q_rad[1] + q_rad[2])
    elbow = _GRAVITY_M_S2 * fore_m * (0.5 * mass_kg[1] + mass_kg[2])
    beyond = mass_kg[1] + mass_kg[2]
    torque_nm[2] = elbow
    torque_nm[1] = elbow + _GRAVITY_M_S2 * upper_m * (0.5 * mass_kg[0] + beyond)


@kernel
def transmission_kernel(
    angle_rad: float, flank: float, load_nm: float, orders: Floats, joint_orders: Floats, joint: Floats
) -> float:
    """Return the transmission error of one gear in rad.

    ``angle_rad``: angle on the motor side, referred to the output.
    ``flank``: -1 when the reverse flank carries the load, +1 when the forward one does.
    ``load_nm``: torque that the gear carries.
    ``orders``, (m,): periods per turn of the output.
    ``joint_orders``, (m, 3): rows of ``transmission_table``.
    ``joint``, (12,): row of ``joint_table``.
    """
    swollen = 1.0 + joint[_FLEXSPLINE] * np.cos(angle_rad - joint[_TURNED])
    swollen *= 1.0 + joint[_LOAD] * np.tanh(abs(load_nm) / joint[_LOAD_NM])
    forward = 0.5 + 0.5 * flank
    error = 0.0
    for m in range(orders.shape[0]):
        amplitude = joint_orders[m, _AMPLITUDE]
        if amplitude != 0.0:
            if orders[m] >= joint[_GEAR_FROM]:
                amplitude *= swollen
            turn = orders[m] * angle_rad
            ahead = np.sin(turn + joint_orders[m, _PHASE_FORWARD])
            behind = np.sin(turn + joint_orders[m, _PHASE_REVERSE])
            error += amplitude * (forward * ahead + (1.0 - forward) * behind)
    return error


@kernel
def wind_up_kernel(torque_nm: float, joint: Floats) -> float:
    """Return how far a gear's spring winds up under a torque, in rad."""
    soft = joint[_SOFT] * joint[_LOAD_NM] * np.tanh(torque_nm / joint[_LOAD_NM])
    return joint[_COMPLIANCE] * (torque_nm + soft)


@kernel
def play_kernel(angle_rad: float, link_rad: float, width_rad: float) -> float:
    """Return the link's angle behind a play of finite width (Prandtl's play operator)."""
    half = 0.5 * width_rad
    return min(max(link_rad, angle_rad - half), angle_rad + half)


_OMEGA, _DAMPING, _POSTURE, _REACH_MM, _FLANGE_SHARE, _SHAPE, _DRIVEN, _JOLTED = (0, 1, 2, 3, 4, 5, 8, 9)
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
    table[:, _SHAPE:_DRIVEN] = shape / np.linalg.norm(shape, axis=1)[:, None]
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
        x = c * modes[m, _SHAPE] - s * modes[m, _SHAPE + 1]
        y = s * modes[m, _SHAPE] + c * modes[m, _SHAPE + 1]
        z = modes[m, _SHAPE + 2]
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
