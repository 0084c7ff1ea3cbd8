"""Joint errors: what the link does when the encoder side is asked for an angle.

Each joint has lost motion (a play operator), a strain-wave gear whose transmission error
depends on the tooth flank that carries the load and swells with load and with the turn of its
flexspline, friction that disturbs the position loop at reversals, and a gear spring that winds up
under the weight of the links: softer about zero torque, and with hysteresis.
"""

from __future__ import annotations

import numpy as np

from dtwin.kinematics import kernel
from dtwin.machines.parameters import JointParameters
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
