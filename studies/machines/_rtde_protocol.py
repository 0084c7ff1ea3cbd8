"""RTDE protocol version 2 as a robot controller speaks it: frames, recipes, variables.

Written from the public description of the Real-Time Data Exchange interface. Numbers travel
big-endian; a frame is its length (16 bit), its type (8 bit) and a payload.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from dtwin.links import layout
from dtwin.links import ur_registers as registers
from dtwin.schema import Floats

REQUEST_VERSION, CONTROLLER_VERSION, TEXT_MESSAGE = 86, 118, 77
NOT_FOUND, IN_USE = "NOT_FOUND", "IN_USE"
SETUP_OUTPUTS, SETUP_INPUTS, START, PAUSE, DATA = 79, 73, 83, 80, 85
_HEADER = struct.Struct(">HB")
_LONGEST = 0xFFFF
_CONTROLLER = (5, 15, 0, 0)

_FORMATS = {
    "DOUBLE": "d",
    "INT32": "i",
    "UINT32": "I",
    "UINT64": "Q",
    "UINT8": "B",
    "BOOL": "?",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
    "VECTOR6INT32": "6i",
}
_TYPES = (
    (r"(out|in)put_int_register_\d+", "INT32"),
    (r"(out|in)put_double_register_\d+", "DOUBLE"),
    (r"(out|in)put_bit_register_\d+", "BOOL"),
    (r"(out|in)put_bit_registers\d+_to_\d+", "UINT32"),
    (r"actual_digital_(in|out)put_bits", "UINT64"),
    (r"robot_mode|safety_mode|safety_status", "INT32"),
    (r"runtime_state|robot_status_bits|safety_status_bits|speed_slider_mask", "UINT32"),
    (r"joint_mode", "VECTOR6INT32"),
    (r"actual_tool_accelerometer|elbow_(position|velocity)|payload_cog", "VECTOR3D"),
    (r"(standard|configurable|tool)_digital_output(_mask)?", "UINT8"),
    (r"standard_analog_output_(mask|type)", "UINT8"),
    (r"(target|actual)_(q|qd|qdd|current|moment|TCP_(pose|speed|force))", "VECTOR6D"),
    (r"actual_joint_voltage|joint_(control_output|temperatures)|payload_inertia", "VECTOR6D"),
    (r"ft_raw_wrench|actual_current_window", "VECTOR6D"),
    (r"timestamp|speed_scaling|target_speed_fraction|speed_slider_fraction", "DOUBLE"),
    (r"standard_analog_(in|out)put_?\d|actual_execution_time|actual_momentum", "DOUBLE"),
    (r"actual_(main|robot)_voltage|actual_robot_current|payload", "DOUBLE"),
)


_PATTERNS = [(re.compile(pattern), kind) for pattern, kind in _TYPES]


def _type_of(variable: str) -> str:
    """Return the RTDE type of a variable, ``"NOT_FOUND"`` when there is no such variable."""
    for pattern, kind in _PATTERNS:
        if pattern.fullmatch(variable):
            return kind
    return "NOT_FOUND"


def frame(kind: int, payload: bytes) -> bytes:
    """Return one frame, ready to send."""
    return _HEADER.pack(len(payload) + _HEADER.size, kind) + payload


class FrameReader:
    """Cuts a byte stream into frames; keeps what is incomplete."""

    def __init__(self) -> None:
        self._held = bytearray()

    def feed(self, received: bytes) -> Iterator[tuple[int, bytes]]:
        """Yield type and payload of every frame that is complete.

        Raises ``ValueError`` when a length is impossible, after which the stream cannot be followed.
        """
        self._held += received
        while len(self._held) >= _HEADER.size:
            size, kind = _HEADER.unpack_from(self._held)
            if size < _HEADER.size:
                raise ValueError("frame shorter than its header")
            if len(self._held) < size:
                return
            payload = bytes(self._held[_HEADER.size : size])
            del self._held[:size]
            yield kind, payload


def _pose(place: int) -> Callable[[Floats], tuple[float, ...]]:
    def read(state: Floats) -> tuple[float, ...]:
        x, y, z = 1e-3 * state[place : place + 3]
        return x, y, z, 0.0, np.pi, 0.0

    return read


def _speed(state: Floats) -> tuple[float, ...]:
    x, y, z = 1e-3 * state[layout.TARGET_SPEED : layout.TARGET_SPEED + 3]
    return x, y, z, 0.0, 0.0, 0.0


def _vector(place: int) -> Callable[[Floats], tuple[float, ...]]:
    return lambda state: tuple(state[place : place + 6].tolist())


def _scalar(place: int) -> Callable[[Floats], tuple[float, ...]]:
    return lambda state: (float(state[place]),)


def _whole(place: int) -> Callable[[Floats], tuple[int, ...]]:
    return lambda state: (int(state[place]),)


def _choice(place: int, yes: int, no: int) -> Callable[[Floats], tuple[int, ...]]:
    return lambda state: (yes if state[place] > 0.5 else no,)


def _coded(place: int, codes: dict[float, int]) -> Callable[[Floats], tuple[int, ...]]:
    return lambda state: (codes[float(state[place])],)


_READERS: dict[str, Callable[[Floats], tuple[float, ...]]] = {
    "timestamp": _scalar(layout.TIMESTAMP),
    "target_q": _vector(layout.TARGET_Q),
    "target_qd": _vector(layout.TARGET_QD),
    "actual_q": _vector(layout.ACTUAL_Q),
    "actual_qd": _vector(layout.ACTUAL_QD),
    "target_TCP_pose": _pose(layout.TARGET_TCP),
    "actual_TCP_pose": _pose(layout.ACTUAL_TCP),
    "target_TCP_speed": _speed,
    # The share of the trajectory limiter; the slider's is the other factor.
    "speed_scaling": lambda state: (1.0,),
    "target_speed_fraction": _scalar(layout.SPEED_SCALING),
    "runtime_state": _coded(layout.RUNTIME_RUNNING, registers.RUNTIME_STATES),
    "robot_mode": lambda state: (7,),
    "safety_mode": _coded(layout.SAFETY_OK, registers.SAFETY_MODES),
    "safety_status_bits": _coded(layout.SAFETY_OK, registers.SAFETY_BITS),
    "robot_status_bits": _choice(layout.RUNTIME_RUNNING, 0b11, 0b01),
    **{f"output_int_register_{number}": _whole(place) for number, place in registers.OUTPUT_INTS.items()},
    f"output_int_register_{registers.OUTPUT_FEED}": lambda state: (
        round(registers.FEED_SCALE * float(state[layout.FEED])),
    ),
    **{f"output_double_register_{number}": _scalar(place) for number, place in registers.OUTPUT_DOUBLES.items()},
}


@dataclass(frozen=True)
class OutputRecipe:
    """What one client wants to receive.

    ``number``: identifier that starts every data frame.
    ``types``: type of each variable; any ``NOT_FOUND`` makes the recipe unusable.
    ``every``: ticks from one data frame to the next.
    ``readers``: from a robot state to the numbers of each variable.
    ``packer``: format of the data frame.
    """

    number: int
    types: tuple[str, ...]
    every: int
    readers: tuple[Callable[[Floats], tuple[float, ...]], ...]
    packer: struct.Struct

    def data(self, state: Floats) -> bytes:
        """Return the data frame of a robot state."""
        values: list[float] = []
        for reader in self.readers:
            values += reader(state)
        return frame(DATA, self.packer.pack(self.number, *values))


def output_recipe(number: int, payload: bytes, rate_hz: float) -> OutputRecipe:
    """Return the recipe that a client asks for."""
    (wanted_hz,) = struct.unpack(">d", payload[:8])
    if not 1.0 <= wanted_hz <= rate_hz:
        raise ValueError("output frequency out of range")
    names = [name for name in payload[8:].decode("ascii").split(",") if name]
    types = tuple(_type_of(name) for name in names)
    formats = [_FORMATS.get(kind, "d") for kind in types]
    readers = []
    for name, form in zip(names, formats, strict=True):
        blank = (0,) * (int(form[0]) if len(form) > 1 else 1)
        readers.append(_READERS.get(name, lambda state, blank=blank: blank))
    packer = struct.Struct(">B" + "".join(formats))
    if packer.size + _HEADER.size > _LONGEST:
        raise ValueError("data frame longer than its length can say")
    return OutputRecipe(number, types, max(1, round(rate_hz / wanted_hz)), tuple(readers), packer)


@dataclass(frozen=True)
class InputRecipe:
    """What one client wants to write."""

    names: tuple[str, ...]
    types: tuple[str, ...]
    packer: struct.Struct

    def values(self, payload: bytes) -> dict[str, float]:
        """Return the scalar variables of a data frame, without its recipe number.

        Raises ``ValueError`` when the frame has another length than the recipe.
        """
        if len(payload) != self.packer.size:
            raise ValueError("data frame does not fit its recipe")
        return dict(zip(self.names, self.packer.unpack(payload), strict=True))


def input_recipe(payload: bytes) -> InputRecipe:
    """Return the input recipe that a client asks for; scalars only."""
    names = tuple(name for name in payload.decode("ascii").split(",") if name)
    types = tuple(_type_of(name) for name in names)
    packer = struct.Struct(">" + "".join(_FORMATS.get(kind, "d") for kind in types))
    if len(packer.unpack(bytes(packer.size))) != len(names):
        raise ValueError("vectors cannot be written")
    return InputRecipe(names, types, packer)


def controller_version() -> bytes:
    """Return the payload that states the controller's software version."""
    return struct.pack(">4I", *_CONTROLLER)
