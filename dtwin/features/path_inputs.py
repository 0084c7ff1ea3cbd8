"""Path inputs of a robot on a circle, from the controller's state alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dtwin.errors import InputError
from dtwin.features.compiled import compiled
from dtwin.kinematics import UR10E, jacobian_kernel
from dtwin.schema import PLANES, Floats

_JOINTS = range(1, 7)

STATE_FIELDS: tuple[str, ...] = (
    "timestamp_s",
    *(f"target_q_{j}_rad" for j in _JOINTS),
    *(f"target_qd_{j}_rad_s" for j in _JOINTS),
    *(f"target_tcp_{axis}_mm" for axis in "xyz"),
    *(f"target_speed_{axis}_mm_s" for axis in "xyz"),
    *(f"centre_{axis}_mm" for axis in "xyz"),
    "plane_id",
    "direction_sign",
    "segment_time_s",
    *(f"applied_{axis}_um" for axis in "xyz"),
    "feed_mm_min",
)
"""What the path inputs are computed from, in the order that the kernel expects."""

PATH_INPUTS: tuple[str, ...] = (
    "path_angle_rad",
    "direction_sign",
    *(f"q{j}_rad" for j in _JOINTS),
    *(f"qd{j}_rad_s" for j in _JOINTS),
    *(f"lever_{j}_mm_rad" for j in _JOINTS),
    "commanded_speed_mm_s",
    "tangential_acceleration_mm_s2",
    "radial_acceleration_mm_s2",
    "segment_time_s",
    *(f"radial_{axis}_1" for axis in "xyz"),
    *(f"acceleration_{axis}_mm_s2" for axis in "xyz"),
    *(f"tangent_{axis}_1" for axis in "xyz"),
    "programmed_feed_mm_min",
)
"""Names of the path inputs, in the order in which the kernel writes them."""

PATH_INPUT_UNITS: dict[str, str] = {
    "path_angle_rad": "rad",
    "direction_sign": "1",
    **{f"q{j}_rad": "rad" for j in _JOINTS},
    **{f"qd{j}_rad_s": "rad/s" for j in _JOINTS},
    **{f"lever_{j}_mm_rad": "mm/rad" for j in _JOINTS},
    "commanded_speed_mm_s": "mm/s",
    "tangential_acceleration_mm_s2": "mm/s^2",
    "radial_acceleration_mm_s2": "mm/s^2",
    "segment_time_s": "s",
    **{f"radial_{axis}_1": "1" for axis in "xyz"},
    **{f"acceleration_{axis}_mm_s2": "mm/s^2" for axis in "xyz"},
    **{f"tangent_{axis}_1": "1" for axis in "xyz"},
    "programmed_feed_mm_min": "mm/min",
}

_CARRY_SIZE = 14
_TURN = 2.0 * np.pi


@compiled
def _path_inputs_kernel(
    state: Floats, index: NDArray[np.int64], dh: Floats, tcp_mm: Floats, carry: Floats, out: Floats
) -> None:
    """Write the path inputs of one sample.

    The lever of joint j is the radial component of the tool's motion per radian of that
    joint: the outward unit vector at the path angle times column j of the position Jacobian.
    The commanded acceleration is the difference of two successive target velocities. The
    outward unit vector, the direction of travel and that acceleration are given in the base
    frame as well. A correction that the controller reports as applied is taken out of position
    and velocity first: the path is what was commanded, not what was added to it.

    Args:
        state: Newest state of the controller. Shape (any,).
        index: Where each of ``STATE_FIELDS`` is in ``state``. Shape (29,).
        dh: Chain, as in ``dtwin.kinematics``. Shape (6, 4).
        tcp_mm: Tool centre point. Shape (3,).
        carry: What is remembered from the sample before; zeros at the start of a run. Overwritten. Shape (14,).
        out: Receives the inputs in the order of ``PATH_INPUTS``. Shape (34,).
    """
    now_s = state[index[0]]
    plane = int(state[index[22]])
    first, second = plane % 3, (plane + 1) % 3
    across = state[index[13 + second]] - state[index[19 + second]]
    along = state[index[13 + first]] - state[index[19 + first]]
    across -= 1e-3 * state[index[25 + second]]
    along -= 1e-3 * state[index[25 + first]]
    angle = np.arctan2(across, along)
    cosine, sine = np.cos(angle), np.sin(angle)
    started = carry[0] > 0.5 and carry[1] == plane
    for i in range(3):
        if carry[2 + i] != state[index[19 + i]]:
            started = False
    turns = carry[6] if started else 0.0
    if started:
        step = angle - carry[5]
        if step > np.pi:
            turns -= 1.0
        elif step < -np.pi:
            turns += 1.0
    out[0] = angle + turns * _TURN
    out[1] = state[index[23]]
    q = np.empty(6)
    for j in range(6):
        q[j] = state[index[1 + j]]
        out[2 + j] = q[j]
        out[8 + j] = state[index[7 + j]]
    jacobian = jacobian_kernel(q, dh, tcp_mm)
    for j in range(6):
        out[14 + j] = cosine * jacobian[first, j] + sine * jacobian[second, j]
    elapsed_s = now_s - carry[7]
    speed = np.zeros(3)
    square = 0.0
    for i in range(3):
        speed[i] = state[index[16 + i]]
        if started and elapsed_s > 0.0:
            speed[i] -= 1e-3 * (state[index[25 + i]] - carry[11 + i]) / elapsed_s
        square += speed[i] ** 2
    if not started or elapsed_s > 0.0:
        out[20] = np.sqrt(square)
    for i in range(3):
        out[24 + i] = 0.0
    out[24 + first], out[24 + second] = cosine, sine
    for i in range(3):
        out[30 + i] = 0.0
    out[30 + first], out[30 + second] = -state[index[23]] * sine, state[index[23]] * cosine
    out[33] = state[index[28]]
    if not started:
        out[21], out[22], out[27], out[28], out[29] = 0.0, 0.0, 0.0, 0.0, 0.0
    elif elapsed_s > 0.0:
        for i in range(3):
            out[27 + i] = (speed[i] - carry[8 + i]) / elapsed_s
        a = out[27 + first]
        b = out[27 + second]
        out[21] = state[index[23]] * (cosine * b - sine * a)
        out[22] = cosine * a + sine * b
    out[23] = state[index[24]]
    carry[0], carry[1], carry[5], carry[6] = 1.0, plane, angle, turns
    for i in range(3):
        carry[2 + i] = state[index[19 + i]]
    if not started or elapsed_s > 0.0:
        carry[7] = now_s
        for i in range(3):
            carry[8 + i] = speed[i]
            carry[11 + i] = state[index[25 + i]]


@compiled
def _path_inputs_many(
    states: Floats, index: NDArray[np.int64], dh: Floats, tcp_mm: Floats, carry: Floats, out: Floats
) -> None:
    for n in range(states.shape[0]):
        if n:
            out[n, 20:23] = out[n - 1, 20:23]
            out[n, 27:30] = out[n - 1, 27:30]
        _path_inputs_kernel(states[n], index, dh, tcp_mm, carry, out[n])


class PathInputs:
    """Path inputs sample by sample, or over a whole record with the same bits.

    Args:
        field_index: Where each of ``STATE_FIELDS`` is in a state vector.
        tcp_mm: Tool centre point in the flange frame. Shape (3,).

    Raises:
        InputError: When a field is missing.
    """

    def __init__(self, field_index: dict[str, int], tcp_mm: Floats) -> None:
        missing = [name for name in STATE_FIELDS if name not in field_index]
        if missing:
            raise InputError(
                "the controller's state lacks what the path inputs need",
                code="motion.state",
                got=", ".join(missing)[:200],
            )
        self._index = np.array([field_index[name] for name in STATE_FIELDS], dtype=np.int64)
        self._tcp_mm = np.ascontiguousarray(tcp_mm, dtype=np.float64)
        self._dh = np.ascontiguousarray(UR10E.dh, dtype=np.float64)
        self._carry = np.zeros(_CARRY_SIZE)
        self.values = np.zeros(len(PATH_INPUTS))

    def reset(self) -> None:
        """Forget the run: the angle is unwrapped afresh."""
        self._carry[:] = 0.0
        self.values[:] = 0.0

    def update(self, state: Floats) -> Floats:
        """Return the inputs (34,) of the newest state (n_fields,); the array is reused by the next call."""
        _path_inputs_kernel(state, self._index, self._dh, self._tcp_mm, self._carry, self.values)
        return self.values

    def batch(self, states: Floats) -> Floats:
        """Return the inputs of a run from its first sample, shape (n, 34).

        Args:
            states: States in order of time. What ``update`` remembers is not touched. Shape (n, n_fields).

        Raises:
            InputError: When the plane is not one of XY, YZ, ZX.
        """
        states = np.ascontiguousarray(states, dtype=np.float64)
        if states.ndim != 2 or states.shape[1] <= self._index.max():
            raise InputError("the states have too few fields", code="motion.state", got=str(states.shape))
        planes = states[:, self._index[22]]
        if not np.isin(planes, np.arange(len(PLANES))).all():
            raise InputError("plane_id must be 0, 1 or 2", code="motion.plane")
        out = np.zeros((len(states), len(PATH_INPUTS)))
        _path_inputs_many(states, self._index, self._dh, self._tcp_mm, np.zeros(_CARRY_SIZE), out)
        return out
