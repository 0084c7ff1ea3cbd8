"""The process that owns ``ur_rtde``'s interfaces; started by ``UrLink``, not by hand.

``ur_rtde`` can hold the interpreter for seconds while it connects and can abort its process
on a broken socket. Here it can do neither harm: the host only sees a process that ended.

Descriptors: shared memory, wake-up of the host, wake-up of this process, and a pipe for
messages. Standard input is the life line: when it ends, the offset is released.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import json
import os
import select
import socket
import struct
import sys
import time
from io import BufferedIOBase
from itertools import zip_longest
from typing import Any

import numpy as np

from dtwin.links import layout
from dtwin.links import ur_registers as registers
from dtwin.links._ur_memory import SharedMemory

RTDE_PORT = 30004
_POLL_S = 0.00008
_EARLY_S = 0.0004
_SETTLE_S = 0.05
_PRIORITY = 60
_SET_TIMER_SLACK = 29
_VERSION, _HEADER = 2, struct.Struct(">HB")
_REQUEST_VERSION, _SETUP_OUTPUTS, _TEXT_MESSAGE = 86, 79, 77
# What ur_rtde says when the controller answers IN_USE to an input recipe.
_OWNED = "already in use"

_VARIABLES = {
    "timestamp": "DOUBLE",
    **dict.fromkeys(("target_q", "target_qd", "actual_q", "actual_qd"), "VECTOR6D"),
    **dict.fromkeys(("target_TCP_pose", "actual_TCP_pose", "target_TCP_speed"), "VECTOR6D"),
    "speed_scaling": "DOUBLE",
    "target_speed_fraction": "DOUBLE",
    "runtime_state": "UINT32",
    "safety_status_bits": "UINT32",
    f"output_int_register_{registers.OUTPUT_FEED}": "INT32",
    **{f"output_int_register_{number}": "INT32" for number in registers.OUTPUT_INTS},
    **{f"output_double_register_{number}": "DOUBLE" for number in registers.OUTPUT_DOUBLES},
}
"""What is asked for, and the type of each: ``ur_rtde`` reads packets by these, whatever the controller answers."""


class _Fault(Exception):
    """A reason to give up; its text goes to the host."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code


def _read_state(receive: Any, state: layout.RobotState) -> None:
    """Copy one consistent package from the receive interface into ``state``.

    The getters read whatever package is newest, so they are repeated when a new one came
    in between.
    """
    for _ in range(4):
        state[layout.TIMESTAMP] = receive.getTimestamp()
        state[layout.TARGET_Q : layout.TARGET_Q + 6] = receive.getTargetQ()
        state[layout.TARGET_QD : layout.TARGET_QD + 6] = receive.getTargetQd()
        state[layout.ACTUAL_Q : layout.ACTUAL_Q + 6] = receive.getActualQ()
        state[layout.ACTUAL_QD : layout.ACTUAL_QD + 6] = receive.getActualQd()
        state[layout.TARGET_TCP : layout.TARGET_TCP + 3] = receive.getTargetTCPPose()[:3]
        state[layout.ACTUAL_TCP : layout.ACTUAL_TCP + 3] = receive.getActualTCPPose()[:3]
        state[layout.TARGET_SPEED : layout.TARGET_SPEED + 3] = receive.getTargetTCPSpeed()[:3]
        state[layout.TARGET_TCP : layout.TARGET_SPEED + 3] *= 1000.0
        state[layout.SPEED_SCALING] = receive.getSpeedScalingCombined()
        state[layout.RUNTIME_RUNNING] = registers.runtime_running(receive.getRuntimeState())
        state[layout.SAFETY_OK] = registers.safety_ok(receive.getSafetyStatusBits())
        feed = receive.getOutputIntRegister(registers.OUTPUT_FEED)
        state[layout.FEED] = feed / registers.FEED_SCALE
        for number, place in registers.OUTPUT_INTS.items():
            state[place] = receive.getOutputIntRegister(number)
        for number, place in registers.OUTPUT_DOUBLES.items():
            state[place] = receive.getOutputDoubleRegister(number)
        if receive.getTimestamp() == state[layout.TIMESTAMP]:
            return


def _write_correction(io: Any, correction: layout.Floats) -> None:
    """Write the offset and then the sequence number that makes it count."""
    taken = True
    for axis in range(3):
        value = float(correction[layout.REGISTER_OFFSET + axis])
        taken = taken and io.setInputDoubleRegister(registers.INPUT_OFFSET_X + axis, value)
    sequence = int(correction[layout.REGISTER_SEQUENCE])
    if not (taken and io.setInputIntRegister(registers.INPUT_SEQUENCE, sequence)):
        raise _Fault("ur.link_lost", "the controller no longer takes corrections")


def _require_rtde(host: str, frequency_hz: float) -> None:
    """Ask for the version of the protocol and for the variables: without them ``ur_rtde`` hangs, or takes this process along.

    Raises ``OSError`` when nobody answers, ``_Fault`` when the controller has not got them.
    """
    with socket.create_connection((host, RTDE_PORT), timeout=2.0) as probe, probe.makefile("rwb") as stream:
        if _asked(stream, _REQUEST_VERSION, struct.pack(">H", _VERSION)) != b"\x01":
            raise _Fault("ur.protocol", f"the controller does not speak version {_VERSION} of RTDE")
        recipe = struct.pack(">d", frequency_hz) + ",".join(_VARIABLES).encode()
        kinds = _asked(stream, _SETUP_OUTPUTS, recipe)[1:].decode("ascii", "replace").split(",")
        sent = dict(zip_longest(_VARIABLES, kinds[: len(_VARIABLES)], fillvalue=""))
        if absent := [name for name, kind in sent.items() if kind in ("", "NOT_FOUND")]:
            raise _Fault("ur.variables", f"the controller does not send {', '.join(absent)}")
        if other := [f"{name} as {kind[:20]}" for name, kind in sent.items() if kind != _VARIABLES[name]]:
            raise _Fault("ur.variables", f"the controller sends other types than RTDE has: {', '.join(other)}")


def _asked(stream: BufferedIOBase, kind: int, payload: bytes) -> bytes:
    """Return the payload that a controller answers a question with; its messages to people are passed over."""
    stream.write(_HEADER.pack(_HEADER.size + len(payload), kind) + payload)
    stream.flush()
    while True:
        head = stream.read(_HEADER.size)
        if len(head) < _HEADER.size:
            raise OSError("it closed the connection")
        size, answered = _HEADER.unpack(head)
        # Before the rest is waited for: what is no RTDE may be silent after its first words.
        if answered not in (kind, _TEXT_MESSAGE):
            raise _Fault("ur.protocol", "what answers is no RTDE")
        answer = stream.read(max(size - _HEADER.size, 0))
        if answered == kind:
            return answer


class _Worker:
    """Moves states up and corrections down until told to stop or the link breaks."""

    def __init__(self, chosen: argparse.Namespace) -> None:
        self._host, self._frequency_hz = chosen.host, chosen.frequency_hz
        self._lost_after_s = chosen.lost_after_s
        self._writes = chosen.writes
        self._memory = SharedMemory(chosen.memory)
        self._state_ready, self._correction_ready = chosen.state_ready, chosen.correction_ready
        self._messages = chosen.messages
        self._correction = layout.correction_registers()
        self._receive: Any = None
        self._io: Any = None

    def say(self, **message: Any) -> None:
        """Send one JSON line to the host."""
        with contextlib.suppress(OSError):
            os.write(self._messages, json.dumps(message).encode() + b"\n")

    def connect(self) -> None:
        """Open both interfaces. Raises ``_Fault`` when the package is missing or no controller answers."""
        try:
            from rtde_io import RTDEIOInterface
            from rtde_receive import RTDEReceiveInterface
        except ImportError as error:
            raise _Fault("ur.package", f"the package ur-rtde is missing ({error})") from error
        try:
            _require_rtde(self._host, self._frequency_hz)
        except OSError as error:
            raise _Fault("ur.absent", f"no robot controller answers ({error})") from error
        try:
            self._receive = RTDEReceiveInterface(self._host, self._frequency_hz, list(_VARIABLES))
            if self._writes:
                self._io = RTDEIOInterface(self._host)
        except (RuntimeError, ValueError) as error:
            first = str(error).strip().splitlines()[0]
            if _OWNED in first:
                text = "another client owns the correction's input registers"
                raise _Fault("ur.registers_owned", text) from error
            raise _Fault("ur.refused", f"the controller refused the connection ({first})") from error

    def run(self) -> None:
        """Serve until the life line ends. Raises ``_Fault`` when the controller is gone or silent for too long."""
        state = layout.empty_state()
        period_s = 1.0 / self._frequency_hz
        # Before the first package ur_rtde tells a time of 0, and no joints.
        newest, seen_s = 0.0, time.monotonic()
        next_look_s = seen_s
        while True:
            wait_s = max(next_look_s - time.monotonic(), 0.0)
            ready, _, _ = select.select([self._correction_ready, sys.stdin], [], [], wait_s)
            if sys.stdin in ready:
                return
            if ready:
                self._forward()
            now_s = time.monotonic()
            if now_s < next_look_s:
                continue
            stamp = self._receive.getTimestamp()
            if stamp != newest:
                newest, seen_s = stamp, now_s
                _read_state(self._receive, state)
                newest = state[layout.TIMESTAMP]
                self._memory.write_state(state, now_s)
                os.eventfd_write(self._state_ready, 1)
                next_look_s = now_s + max(period_s - _EARLY_S, _POLL_S)
                continue
            next_look_s = now_s + _POLL_S
            if now_s - seen_s > 5 * period_s:
                self._require_link(now_s - seen_s)
                next_look_s = now_s + period_s / 4

    def release(self) -> None:
        """Lead the offset back to zero, whatever else is wrong, and leave."""
        with contextlib.suppress(Exception):
            if self._correction[layout.REGISTER_SEQUENCE] != 0:
                last = int(self._correction[layout.REGISTER_SEQUENCE])
                zero = layout.correction_registers(last % layout.SEQUENCE_LIMIT + 1)
                _write_correction(self._io, zero)
                time.sleep(_SETTLE_S)
        for interface in (self._io, self._receive):
            with contextlib.suppress(Exception):
                interface.disconnect()

    def _forward(self) -> None:
        os.eventfd_read(self._correction_ready)
        if self._io is not None and self._memory.read_correction(self._correction):
            _write_correction(self._io, self._correction)

    def _require_link(self, silent_s: float) -> None:
        if not self._receive.isConnected():
            raise _Fault("ur.link_lost", "the robot controller closed the connection")
        if silent_s > self._lost_after_s:
            raise _Fault("ur.silent", f"the robot controller sent nothing for {silent_s:z.1f} s")


def _prepare(realtime: bool) -> bool:
    """Ask for precise timers and, if wanted and allowed, real-time priority."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(_SET_TIMER_SLACK, 1000, 0, 0, 0)
    if not realtime:
        return False
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))
    except (OSError, AttributeError):
        return False
    return True


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--host", required=True)
    parser.add_argument("--frequency-hz", type=float, required=True)
    parser.add_argument("--lost-after-s", type=float, required=True)
    parser.add_argument("--realtime", action="store_true")
    parser.add_argument("--writes", action="store_true", help="claim the input registers")
    for name in ("memory", "state-ready", "correction-ready", "messages"):
        parser.add_argument(f"--{name}", type=int, required=True)
    return parser.parse_args()


def main() -> int:
    """Run the driver; return 0 after a release, 1 after a fault."""
    chosen = _arguments()
    worker = _Worker(chosen)
    try:
        # Before connecting: the threads that ur_rtde starts inherit priority and timers.
        realtime = _prepare(chosen.realtime)
        worker.connect()
        worker.say(connected=True, realtime=realtime)
        worker.run()
    except _Fault as fault:
        worker.say(fault=fault.code, message=str(fault))
        return 1
    except KeyboardInterrupt:
        return 0
    finally:
        worker.release()
    return 0


if __name__ == "__main__":
    np.seterr(all="ignore")
    raise SystemExit(main())
