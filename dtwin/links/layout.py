"""Layout of one robot state and of one correction, as every link and machine exchanges them.

A state is a flat array of float64 in the order of ``NAMES``, so that it fits shared memory,
a ring buffer and a compiled kernel alike. Positions are in the robot's base frame.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

RobotState: TypeAlias = Floats
"""Array of shape (N,), float64, in the order of ``NAMES``."""


def _joints(prefix: str, suffix: str) -> tuple[str, ...]:
    return tuple(f"{prefix}_{joint}_{suffix}" for joint in range(1, 7))


def _axes(prefix: str, suffix: str) -> tuple[str, ...]:
    return tuple(f"{prefix}_{axis}_{suffix}" for axis in "xyz")


NAMES: tuple[str, ...] = (
    "timestamp_s",
    *_joints("target_q", "rad"),
    *_joints("target_qd", "rad_s"),
    *_joints("actual_q", "rad"),
    *_joints("actual_qd", "rad_s"),
    *_axes("target_tcp", "mm"),
    *_axes("actual_tcp", "mm"),
    *_axes("target_speed", "mm_s"),
    "speed_scaling",
    "runtime_running",
    "safety_ok",
    "segment_id",
    "segment_time_s",
    "plane_id",
    *_axes("centre", "mm"),
    "radius_mm",
    "direction_sign",
    "feed_mm_min",
    "applied_sequence",
    *_axes("applied", "um"),
)
N = len(NAMES)
INDEX: dict[str, int] = {name: place for place, name in enumerate(NAMES)}

TIMESTAMP = 0
TARGET_Q = 1
TARGET_QD = 7
ACTUAL_Q = 13
ACTUAL_QD = 19
TARGET_TCP = 25
ACTUAL_TCP = 28
TARGET_SPEED = 31
SPEED_SCALING = 34
RUNTIME_RUNNING = 35
SAFETY_OK = 36
SEGMENT_ID = 37
SEGMENT_TIME = 38
PLANE_ID = 39
CENTRE = 40
RADIUS = 43
DIRECTION_SIGN = 44
FEED = 45
APPLIED_SEQUENCE = 46
APPLIED = 47

RUNNING, STOPPED, PAUSED = 1.0, 0.0, -1.0
"""Values of ``runtime_running``: a paused program comes back by itself, a stopped one does not."""

SAFE, PROTECTIVE_STOP, EMERGENCY = 1.0, 0.0, -1.0
"""Values of ``safety_ok``: a stop that an operator unlocks, and one after which nothing moves
again before somebody has looked (emergency stop, violation, fault)."""

PLANE_OF_ID: tuple[str, ...] = ("XY", "YZ", "ZX")
"""``plane_id`` counts through this tuple."""

SEQUENCE_LIMIT = 2**31 - 1
"""Sequence numbers travel as a signed 32-bit register and start again at 1 after this."""

# Correction registers: sequence, then offset in um along base x, y, z.
REGISTERS_N = 4
REGISTER_SEQUENCE = 0
REGISTER_OFFSET = 1


def empty_state() -> RobotState:
    """Return a state of zeros, shape (N,)."""
    return np.zeros(N)


def correction_registers(sequence: int = 0, offset_um: Floats | tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Floats:
    """Return correction registers, shape (4,): sequence number, then offset in um.

    Args:
        sequence: Changes with every new offset; 0 means that none was ever sent.
        offset_um: Offset along base x, y and z. Shape (3,).
    """
    registers = np.empty(REGISTERS_N)
    registers[REGISTER_SEQUENCE] = sequence
    registers[REGISTER_OFFSET:] = offset_um
    return registers


# Periods of its own rate for which a value holds.
_GOOD_FOR = 3.0


class LiveValues:
    """Newest values of the inputs that a control provides.

    Args:
        rates_hz: Rate at which each is renewed, by name.

    Attributes:
        names (tuple of str): In the order of ``values``.
        values (ndarray, shape (n,)): NaN while there is none, or only an old one. Overwritten in place. Shape (n,).
    """

    def __init__(self, rates_hz: Mapping[str, float]) -> None:
        self.names = tuple(rates_hz)
        self.values: Floats = np.full(len(self.names), math.nan)
        self._place = {name: number for number, name in enumerate(self.names)}
        self._good_s = np.array([_GOOD_FOR / rate for rate in rates_hz.values()])
        self._until_s = np.full(len(self.names), -math.inf)

    def take(self, given: Mapping[str, float], stamp_s: float) -> None:
        """Take what came with a state, and drop what is too old.

        Args:
            given: Finite numbers; names that were not asked for are left alone.
            stamp_s: The control's stamp of the state.
        """
        for name, value in given.items():
            place = self._place.get(name)
            if place is not None:
                self.values[place] = value
                self._until_s[place] = stamp_s + self._good_s[place]
        self.values[self._until_s < stamp_s] = math.nan

    def old(self) -> tuple[str, ...]:
        """Return the names without a value that holds."""
        missing = np.isnan(self.values)
        return tuple(name for name, gone in zip(self.names, missing, strict=True) if gone)

    def forget(self) -> None:
        """Drop every value, as for another connection."""
        self.values[:] = math.nan
        self._until_s[:] = -math.inf
