"""One tick of the virtual cobot: from path time to where the tool really is."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dtwin.kinematics import UR10E, forward_kernel, inverse_kernel, kernel, long_kernel
from dtwin.links import layout
from dtwin.machines import _joints as j_
from dtwin.machines._joints import (
    gravity_torque_kernel,
    mode_table,
    modes_kernel,
    play_kernel,
    transmission_kernel,
    wind_up_kernel,
)
from dtwin.machines.motion import START_S, jolt_kernel, path_kernel
from dtwin.machines.parameters import CobotParameters
from dtwin.schema import Floats

# The kernel's own names, so that numba sees plain integers.
_TARGET_Q, _TARGET_QD = layout.TARGET_Q, layout.TARGET_QD
_ACTUAL_Q, _ACTUAL_QD = layout.ACTUAL_Q, layout.ACTUAL_QD
_TARGET_TCP, _ACTUAL_TCP = layout.TARGET_TCP, layout.ACTUAL_TCP
_TARGET_SPEED, _SCALING = layout.TARGET_SPEED, layout.SPEED_SCALING
_SEGMENT_ID, _SEGMENT_TIME = layout.SEGMENT_ID, layout.SEGMENT_TIME
_APPLIED_SEQUENCE, _APPLIED = layout.APPLIED_SEQUENCE, layout.APPLIED
_PLAY_WIDTH, _FRICTION, _FRICTION_WIDTH = j_.PLAY_WIDTH, j_.FRICTION, j_.FRICTION_WIDTH
_FRICTION_RECOVERY, _HYSTERESIS_NM = j_.FRICTION_RECOVERY, j_.HYSTERESIS_NM

# Truth row: nominal path, tool, flange, rigid tool, rotation.
_PATH, TCP, FLANGE, RIGID, ROTATION, TRUTH_N = 0, 3, 6, 9, 12, 21

# Memory of the mechanism.
_PATH_TIME, _SPEED_FACTOR, _STARTED, _Q, _PLAY, _PRESS, _RELAXED = 0, 1, 2, 3, 9, 15, 21
_QA, _LAST_TARGET, _RIGID1, _RIGID2, _MODES = 27, 33, 36, 39, 42
_LATCHED, _SLEWED, _LAGGED, _SEQUENCE, _AGE, _QUEUE = 50, 53, 56, 59, 60, 61
_QUEUE_MAX = 32
_LET_GO = _QUEUE + 3 * _QUEUE_MAX
# Torque behind the hysteresis of the six gears.
_TORQUE = _LET_GO + 1
_MEMORY_N = _TORQUE + 6

# Constants of the controller.
_TICK_S, _LIMIT, _STEP, _DELAY_TICKS, _LAG, _WATCH_TICKS, _JOLTS = range(7)


class Mechanism(NamedTuple):
    """Constants of one machine under one condition, as the kernel takes them.

    ``dh``, (2, 6, 4): nominal and true kinematic parameters.
    ``joints``, (6, 12): from ``joint_table``.
    ``orders``, ``transmission``: orders per turn, and ``transmission_table``.
    ``masses_kg``, (3,): moving masses.
    ``modes``, (modes, 10): from ``mode_table``.
    ``control``, (9,): tick, offset limit in mm, offset step per tick in mm, delay in ticks, lag factor, watchdog in
    ticks, jolt constants (3).
    ``geometry``, (5, 3): tool centre point, set-up zero, and tool rotation, in mm.
    """

    dh: Floats
    joints: Floats
    orders: Floats
    transmission: Floats
    masses_kg: Floats
    modes: Floats
    control: Floats
    geometry: Floats


def build_mechanism(parameters: CobotParameters, transmission: Floats, true_dh: Floats, rotation: Floats) -> Mechanism:
    """Return the constants of a machine, its set-up zero still at nought."""
    controller, structure = parameters.controller, parameters.structure
    tick_s = 1.0 / controller.rate_hz
    control = np.array(
        [
            tick_s,
            1e-3 * controller.offset_limit_um,
            1e-3 * controller.offset_rate_um_s * tick_s,
            min(round(controller.actuator_delay_s / tick_s), _QUEUE_MAX - 1),
            1.0 - np.exp(-tick_s / max(controller.actuator_lag_s, 1e-9)),
            round(controller.watchdog_s / tick_s),
            structure.jolt_speed_share,
            structure.restart_share,
            structure.jolt_s,
        ]
    )
    geometry = np.zeros((5, 3))
    geometry[0, 2] = parameters.motion.tcp_z_mm
    geometry[2:] = rotation
    return Mechanism(
        np.stack([UR10E.dh, true_dh]),
        j_.joint_table(parameters.joints),
        np.array(parameters.joints.orders_per_turn),
        transmission,
        np.array(parameters.joints.mass_kg),
        mode_table(parameters.structure),
        control,
        geometry,
    )


def start_memory(q_rad: Floats) -> Floats:
    """Return the memory of a machine at rest at joint angles ``q_rad``."""
    memory = np.zeros(_MEMORY_N)
    memory[_SPEED_FACTOR] = 1.0
    for place in (_Q, _PLAY, _QA):
        memory[place : place + 6] = q_rad
    return memory


def set_speed_factor(memory: Floats, factor: float) -> None:
    """Scale the speed along the path from now on; 0 stops it."""
    memory[_SPEED_FACTOR] = factor


def adopt_sequence(memory: Floats, sequence: int) -> None:
    """Take a sequence number as already seen: nothing counts before a vector of zeros."""
    memory[_SEQUENCE] = sequence
    memory[_LET_GO] = float(sequence != 0)


def commanded_offset_um(memory: Floats) -> Floats:
    """Return the offset (3,) that was latched, limited in size and rate, in um."""
    return 1e3 * memory[_SLEWED : _SLEWED + 3]


def path_time_s(memory: Floats) -> float:
    """Return how far the program has run."""
    return float(memory[_PATH_TIME])


@kernel
def _apply_registers(registers: Floats, control: Floats, memory: Floats) -> None:
    """Latch, limit, delay and lag the offset; the sequence number is the heartbeat.

    Whoever was away for longer than the watchdog begins at zero: once it has dropped a correction,
    nothing counts before a vector of zeros.
    """
    if registers[0] != memory[_SEQUENCE]:
        memory[_SEQUENCE] = registers[0]
        zeros = registers[1] == 0.0 and registers[2] == 0.0 and registers[3] == 0.0
        if memory[_LET_GO] == 0.0 or zeros:
            memory[_AGE] = memory[_LET_GO] = 0.0
            for i in range(3):
                wanted = 1e-3 * registers[1 + i]
                if not np.isfinite(wanted):
                    wanted = 0.0
                memory[_LATCHED + i] = min(max(wanted, -control[_LIMIT]), control[_LIMIT])
    else:
        memory[_AGE] += 1.0
        if memory[_AGE] >= control[_WATCH_TICKS]:
            for i in range(3):
                if memory[_LATCHED + i] != 0.0:
                    memory[_LET_GO] = 1.0
                memory[_LATCHED + i] = 0.0
    delay = int(control[_DELAY_TICKS])
    for i in range(3):
        change = memory[_LATCHED + i] - memory[_SLEWED + i]
        memory[_SLEWED + i] += min(max(change, -control[_STEP]), control[_STEP])
        queue = _QUEUE + i * _QUEUE_MAX
        for n in range(delay, 0, -1):
            memory[queue + n] = memory[queue + n - 1]
        memory[queue] = memory[_SLEWED + i]
        memory[_LAGGED + i] += control[_LAG] * (memory[queue + delay] - memory[_LAGGED + i])


@kernel
def _link_angles(q_rad: Floats, machine: Mechanism, memory: Floats, actual_rad: Floats, link_rad: Floats) -> None:
    torque = np.zeros(6)
    gravity_torque_kernel(q_rad, machine.dh[0], machine.masses_kg, torque)
    tick_s = machine.control[_TICK_S]
    for j in range(6):
        table = machine.joints[j]
        moved = q_rad[j] - memory[_Q + j]
        press = memory[_PRESS + j] + 2.0 * moved / table[_FRICTION_WIDTH]
        press = min(max(press, -1.0), 1.0)
        memory[_PRESS + j] = press
        relaxed = memory[_RELAXED + j]
        relaxed += (press - relaxed) * tick_s / table[_FRICTION_RECOVERY]
        memory[_RELAXED + j] = relaxed
        angle = q_rad[j] - table[_FRICTION] * (press - relaxed)
        actual_rad[j] = angle
        behind = play_kernel(angle, memory[_PLAY + j], table[_PLAY_WIDTH])
        memory[_PLAY + j] = behind
        half = 0.5 * table[_PLAY_WIDTH]
        flank = (angle - behind) / half if half > 0.0 else 0.0
        felt = play_kernel(torque[j], memory[_TORQUE + j], table[_HYSTERESIS_NM])
        memory[_TORQUE + j] = felt
        ripple = transmission_kernel(angle, flank, torque[j], machine.orders, machine.transmission[j], table)
        link_rad[j] = behind + ripple + wind_up_kernel(felt, table)


@kernel
def tick_kernel(
    machine: Mechanism, segments: Floats, frame: Floats, registers: Floats, memory: Floats, state: Floats, truth: Floats
) -> None:
    """Advance the machine by one controller period.

    ``segments``, ``frame``: as in ``MotionPlan``.
    ``registers``, (4,): correction as received: sequence number and offset in um.
    ``memory``, (MEMORY_N,): state of the mechanism; updated.
    ``state``, (layout.N,): receives what the controller reports.
    ``truth``, (TRUTH_N,): receives what really happens.
    """
    tick_s, tcp = machine.control[_TICK_S], machine.geometry[0]
    _apply_registers(registers, machine.control, memory)
    target = np.empty(3)
    segment = path_kernel(memory[_PATH_TIME], segments, frame, target)
    for i in range(3):
        truth[_PATH + i] = target[i]
        target[i] += memory[_LAGGED + i]
    q, _ = inverse_kernel(target, machine.geometry[2:], machine.dh[0], tcp, memory[_Q : _Q + 6])
    actual, link = np.empty(6), np.empty(6)
    _link_angles(q, machine, memory, actual, link)
    rigid, rotation = forward_kernel(link, machine.dh[1], tcp)
    seen, _ = forward_kernel(actual, machine.dh[0], tcp)
    if memory[_STARTED] == 0.0:
        memory[_STARTED] = 1.0
        for i in range(3):
            memory[_RIGID1 + i] = rigid[i]
            memory[_RIGID2 + i] = rigid[i]
            memory[_LAST_TARGET + i] = target[i]
    shaken, flange, true, jolt = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    jolts = machine.control[_JOLTS : _JOLTS + 3]
    jolt_kernel(memory[_PATH_TIME], segments[segment], frame, jolts, jolt)
    for i in range(3):
        bend = rigid[i] - 2.0 * memory[_RIGID1 + i] + memory[_RIGID2 + i]
        shaken[i] = bend / tick_s**2
        rigid_here = rigid[i] - machine.geometry[1, i]
        truth[RIGID + i] = rigid_here
        true[i] = rigid_here
        flange[i] = rigid_here
        for k in range(3):
            flange[i] -= rotation[i, k] * tcp[k]
            truth[ROTATION + 3 * i + k] = rotation[i, k]
        memory[_RIGID2 + i] = memory[_RIGID1 + i]
        memory[_RIGID1 + i] = rigid[i]
    reach = np.hypot(rigid[0], rigid[1])
    place = memory[_MODES : _MODES + 8]
    modes_kernel(machine.modes, tick_s, q[0], reach, shaken, jolt, place, true, flange)
    for i in range(3):
        truth[TCP + i] = true[i]
        truth[FLANGE + i] = flange[i]
        state[_TARGET_TCP + i] = target[i]
        state[_ACTUAL_TCP + i] = seen[i]
        state[_TARGET_SPEED + i] = (target[i] - memory[_LAST_TARGET + i]) / tick_s
        state[_APPLIED + i] = 1e3 * memory[_LAGGED + i]
        memory[_LAST_TARGET + i] = target[i]
    for j in range(6):
        state[_TARGET_Q + j] = q[j]
        state[_TARGET_QD + j] = (q[j] - memory[_Q + j]) / tick_s
        state[_ACTUAL_Q + j] = actual[j]
        state[_ACTUAL_QD + j] = (actual[j] - memory[_QA + j]) / tick_s
        memory[_Q + j] = q[j]
        memory[_QA + j] = actual[j]
    began_s = memory[_PATH_TIME] - segments[segment, START_S]
    state[_SEGMENT_ID] = segment
    state[_SEGMENT_TIME] = max(began_s, 0.0)
    state[_SCALING] = memory[_SPEED_FACTOR]
    state[_APPLIED_SEQUENCE] = memory[_SEQUENCE] if memory[_LET_GO] == 0.0 else 0.0
    memory[_PATH_TIME] += tick_s * memory[_SPEED_FACTOR]


@long_kernel
def run_kernel(
    machine: Mechanism,
    segments: Floats,
    frame: Floats,
    registers: Floats,
    memory: Floats,
    states: Floats,
    truths: Floats,
) -> None:
    """Run a program tick by tick; rows of ``states`` and ``truths`` are ticks.

    ``registers``, (n, 4): correction as received in each tick; the last one stays.
    """
    for n in range(states.shape[0]):
        received = registers[min(n, registers.shape[0] - 1)]
        tick_kernel(machine, segments, frame, received, memory, states[n], truths[n])
        states[n, 0] = n * machine.control[_TICK_S]


@kernel
def run_joints_kernel(machine: Mechanism, q_rad: Floats, memory: Floats, tool_mm: Floats) -> None:
    """Follow joint angles, shape (n, 6), tick by tick and write where the tool is, shape (n, 3).

    The same gears, friction and structure as ``tick_kernel``, for programs that move in joint
    space; the correction registers play no part.
    """
    tick_s, tcp = machine.control[_TICK_S], machine.geometry[0]
    actual, link = np.empty(6), np.empty(6)
    shaken, jolt = np.empty(3), np.zeros(3)
    true, flange = np.empty(3), np.empty(3)
    for n in range(q_rad.shape[0]):
        _link_angles(q_rad[n], machine, memory, actual, link)
        rigid, _ = forward_kernel(link, machine.dh[1], tcp)
        if memory[_STARTED] == 0.0:
            memory[_STARTED] = 1.0
            for i in range(3):
                memory[_RIGID1 + i] = rigid[i]
                memory[_RIGID2 + i] = rigid[i]
        for i in range(3):
            bend = rigid[i] - 2.0 * memory[_RIGID1 + i] + memory[_RIGID2 + i]
            shaken[i] = bend / tick_s**2
            true[i] = rigid[i] - machine.geometry[1, i]
            flange[i] = true[i]
            memory[_RIGID2 + i] = memory[_RIGID1 + i]
            memory[_RIGID1 + i] = rigid[i]
        place = memory[_MODES : _MODES + 8]
        reach = np.hypot(rigid[0], rigid[1])
        modes_kernel(machine.modes, tick_s, q_rad[n, 0], reach, shaken, jolt, place, true, flange)
        for j in range(6):
            memory[_Q + j] = q_rad[n, j]
        for i in range(3):
            tool_mm[n, i] = true[i]
