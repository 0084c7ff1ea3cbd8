"""The virtual cobot on the wall clock, behind a real RTDE server in a process of its own.

``python -m studies.machines.rtde_server --port 0`` prints one JSON line with the port when it is
ready. With ``--control`` it takes JSON lines on standard input, each answered by one on
standard output, and ends when its input ends::

    {"do": "drop"}                          cut every connection
    {"do": "stall", "seconds": 1.0}         neither read nor send; the robot moves on
    {"do": "half_frame"}                    send half a frame, then cut the connection
    {"do": "slow", "factor": 4}             send every fourth state only (1 ends it)
    {"do": "speed", "factor": 0.5}          move the speed slider
    {"do": "protective_stop"}               stop for safety, as after a collision
    {"do": "emergency_stop"}                stop as the emergency button does
    {"do": "pause"}                         hold the program
    {"do": "resume"}                        unlock any stop, go on with the program
    {"do": "intrude", "sequence": 7}        write the registers as a fieldbus would, by the side
    {"do": "clock_jump", "seconds": -5.0}   shift the controller's clock
    {"do": "offset_log", "path": "..."}     write what the program commanded, tick by tick, as .npz
    {"do": "latency_log", "path": "..."}    write what arrived when, as .npz
    {"do": "recording", "path": "..."}      write the ball bar of the newest finished run
    {"do": "status"}                        ticks, late ticks, clients
    {"do": "quit"}
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import ipaddress
import json
import os
import select
import socket
import sys
import time
from collections import deque
from dataclasses import replace
from typing import Any

import numpy as np

from dtwin.errors import DtwinError, InputError
from dtwin.links import layout
from dtwin.links import ur_registers as registers
from dtwin.machines.cobot import VirtualCobot
from dtwin.machines.controller import CircleController
from dtwin.machines.motion import CircleCondition
from dtwin.machines.parameters import load_parameters
from studies.machines._offset_log import OffsetLog
from studies.machines._rtde_session import Session

_LOG_LENGTH = 500_000
_CATCH_UP_TICKS = 250
_PRIORITY = 70
# A fieldbus writes again and again; this long it is the last before each tick.
_INTRUDED_TICKS = 25


class _RtdeServer:
    """Runs a condition on the virtual cobot in real time and serves it by RTDE.

    ``host``: loopback address to listen on.
    ``port``: port, 0 for a free one.
    ``repeat_forever``: start the program again whenever it ends.
    Raises ``InputError`` when the host is not a loopback address.
    """

    def __init__(
        self,
        cobot: VirtualCobot,
        condition: CircleCondition,
        *,
        host: str = "127.0.0.1",
        port: int = 0,
        repeat_forever: bool = False,
    ) -> None:
        if not ipaddress.ip_address(host).is_loopback:
            raise InputError(
                "the virtual robot serves this machine only", code="rtde.host", got=host, allowed="127.0.0.0/8"
            )
        self._cobot, self._condition = cobot, condition
        self._repeat_forever = repeat_forever
        self._rate_hz = cobot.parameters.controller.rate_hz
        self._repeat = 1
        self._controller = cobot.controller(condition, setup="live", repeat=1)
        self._finished: CircleController | None = None
        self._registers = layout.correction_registers()
        self._pending = [0.0, 0.0, 0.0]
        self._state = self._controller.state().copy()
        self._tick = 0
        self._late = 0
        self._late_ticks: deque[int] = deque(maxlen=_LOG_LENGTH)
        self._worst_late_s = 0.0
        self._slowdown = 1
        self._quiet_until_s = 0.0
        self._speed_factor = 1.0
        self._log: deque[tuple[float, float, float]] = deque(maxlen=_LOG_LENGTH)
        self._sessions: list[Session] = []
        self._owners: dict[str, Session] = {}
        self._offsets = OffsetLog(1.0 / self._rate_hz)
        self._clock_shift_s = 0.0
        self._intruder, self._intruded_until_tick = 0, -1
        self._stopping = False
        self._commands = b""
        self._listener = socket.create_server((host, port), backlog=8)
        self._listener.setblocking(False)
        self._t0_s = 0.0

    @property
    def port(self) -> int:
        """Port that the server listens on."""
        return int(self._listener.getsockname()[1])

    def run(self, control: int | None = None) -> None:
        """Serve until told to quit, or until a program that is not repeated has ended.

        ``control``: descriptor that JSON commands come from; its end ends the server.
        """
        gc.collect()
        gc.freeze()
        gc.disable()
        self._t0_s = time.perf_counter()
        while not self._stopping:
            due_s = self._t0_s + (self._tick + 1) / self._rate_hz
            left_s = due_s - time.perf_counter()
            if left_s > 0.0:
                self._attend(left_s, control)
                continue
            if -left_s > 0.5 / self._rate_hz:
                self._late += 1
                self._late_ticks.append(self._tick + 1)
                self._worst_late_s = max(self._worst_late_s, -left_s)
            self._skip_after_a_pause(-left_s)
            self._advance()
        for session in self._sessions:
            session.close()
        self._listener.close()

    def _skip_after_a_pause(self, late_s: float) -> None:
        """Give up real time after the host slept, instead of flooding the clients."""
        if late_s * self._rate_hz > _CATCH_UP_TICKS:
            self._t0_s += late_s

    def _attend(self, left_s: float, control: int | None) -> None:
        # A client can go while it is published to, which closes its descriptor.
        self._sessions = [session for session in self._sessions if session.open]
        quiet = time.perf_counter() < self._quiet_until_s
        watched: list[Any] = [] if quiet else [self._listener, *self._sessions]
        if control is not None:
            watched.append(control)
        ready, _, _ = select.select(watched, [], [], left_s)
        for source in ready:
            if source is self._listener:
                with contextlib.suppress(BlockingIOError):
                    connection, _ = self._listener.accept()
                    self._sessions.append(self._session(connection))
            elif source is control:
                self._read_control(control)
            else:
                source.receive()

    def _session(self, connection: socket.socket) -> Session:
        return Session(connection, self._rate_hz, self._write, self._owners)

    def _write(self, name: str, value: float) -> None:
        """Take one variable; the sequence number makes the offsets count."""
        if name == f"input_int_register_{registers.INPUT_SEQUENCE}":
            if value != self._registers[layout.REGISTER_SEQUENCE]:
                arrived_s = time.perf_counter() - self._t0_s
                self._log.append((value, arrived_s, (self._tick + 1) / self._rate_hz))
            self._registers[layout.REGISTER_SEQUENCE] = value
            self._registers[layout.REGISTER_OFFSET :] = self._pending
        for axis in range(3):
            if name == f"input_double_register_{registers.INPUT_OFFSET_X + axis}":
                self._pending[axis] = value

    def _advance(self) -> None:
        if self._controller.done:
            self._end_program()
            if self._stopping:
                return
        if self._tick < self._intruded_until_tick:
            self._registers[layout.REGISTER_SEQUENCE] = self._intruder
        self._controller.step(self._registers)
        self._tick += 1
        self._state[:] = self._controller.state()
        self._state[layout.TIMESTAMP] = self._tick / self._rate_hz + self._clock_shift_s
        self._offsets.add(
            self._tick,
            self._registers[layout.REGISTER_SEQUENCE],
            self._controller.commanded_um,
            self._registers[layout.REGISTER_OFFSET :],
        )
        if time.perf_counter() >= self._quiet_until_s:
            for session in self._sessions:
                session.publish(self._tick, self._state, self._slowdown)

    def _end_program(self) -> None:
        self._finished = self._controller
        if not self._repeat_forever:
            self._stopping = True
            return
        self._repeat += 1
        self._controller = self._cobot.controller(self._condition, setup="live", repeat=self._repeat)
        self._controller.adopt_sequence(int(self._registers[layout.REGISTER_SEQUENCE]))
        self._controller.set_speed_scaling(self._speed_factor)

    def _read_control(self, descriptor: int) -> None:
        received = os.read(descriptor, 65536)
        self._stopping = self._stopping or not received
        self._commands += received
        *lines, self._commands = self._commands.split(b"\n")
        for line in lines:
            self._obey(line)

    def _obey(self, line: bytes) -> None:
        try:
            command = json.loads(line)
            answer = self._do(command["do"], command)
        except (ValueError, KeyError, TypeError, OSError) as error:
            answer = {"error": f"{type(error).__name__}: {error}"}
        _say({"did": None} | answer)

    def _do(self, action: str, command: dict[str, Any]) -> dict[str, Any]:
        if action == "quit":
            self._stopping = True
        elif action == "drop":
            self._drop()
        elif action == "stall":
            self._quiet_until_s = time.perf_counter() + float(command["seconds"])
        elif action == "half_frame":
            for session in self._sessions:
                session.publish_half(self._state)
            self._drop()
        elif action == "slow":
            self._slowdown = max(1, int(command["factor"]))
        elif action == "speed":
            self._speed_factor = float(command["factor"])
            self._controller.set_speed_scaling(self._speed_factor)
        elif action in ("protective_stop", "emergency_stop", "pause"):
            getattr(self._controller, action)()
        elif action == "resume":
            self._controller.resume(self._speed_factor)
        elif action == "intrude":
            self._intruder = int(command["sequence"])
            self._intruded_until_tick = self._tick + _INTRUDED_TICKS
        elif action == "clock_jump":
            self._clock_shift_s += float(command["seconds"])
        elif action == "offset_log":
            self._offsets.save(command["path"])
        elif action == "latency_log":
            self._write_log(command["path"])
        elif action == "recording":
            return {"did": action, **self._write_recording(command["path"])}
        elif action == "status":
            return {"did": action, **self._status()}
        else:
            raise ValueError(f"unknown command {action!r}")
        return {"did": action}

    def _drop(self) -> None:
        self._offsets.cut_tick = self._tick
        for session in self._sessions:
            session.close()

    def _status(self) -> dict[str, Any]:
        return {
            "ticks": self._tick,
            "late_ticks": self._late,
            "worst_late_s": self._worst_late_s,
            "clients": len(self._sessions),
            "programs": self._repeat,
            "applied_um": self._state[layout.APPLIED : layout.APPLIED + 3].tolist(),
        }

    def _write_log(self, path: str) -> None:
        """Write sequence, arrival, the stamp at which it acts, and the ticks made late here."""
        log = np.array(self._log).reshape(-1, 3)
        np.savez(
            path,
            sequence=log[:, 0],
            arrived_s=log[:, 1],
            latched_s=log[:, 2],
            late_ticks=np.array(self._late_ticks, dtype=np.int64),
        )

    def _write_recording(self, path: str) -> dict[str, Any]:
        if self._finished is None:
            return {"error": "no program has ended yet"}
        recording = self._finished.recording()
        np.savez(path, deviation_mm=recording.deviation_mm, window=np.array(recording.window))
        return {"samples": len(recording.deviation_mm)}


def _cobot(seed: int, watchdog_s: float | None) -> VirtualCobot:
    parameters = load_parameters()
    if watchdog_s is not None:
        controller = replace(parameters.controller, watchdog_s=watchdog_s)
        parameters = replace(parameters, controller=controller)
    return VirtualCobot(parameters, seed=seed)


def _say(message: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(message) + "\n")
    sys.stdout.flush()


def _take_priority() -> bool:
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))
    except (OSError, AttributeError):
        return False
    return True


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="virtual cobot behind an RTDE server")
    parser.add_argument("--host", default="127.0.0.1", help="loopback address")
    parser.add_argument("--port", type=int, default=30004, help="0 for a free one")
    parser.add_argument("--plane", default="XY")
    parser.add_argument("--radius-mm", type=float, default=100.0)
    parser.add_argument("--feed-mm-min", type=float, default=3000.0)
    parser.add_argument("--direction", default="CCW", choices=["CCW", "CW"])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--watchdog-s", type=float, help="silence after which the program leads the offset to zero")
    parser.add_argument("--repeat-forever", action="store_true")
    parser.add_argument("--realtime", action="store_true", help="real-time priority, as a controller has")
    parser.add_argument("--control", action="store_true", help="JSON commands on stdin")
    return parser.parse_args()


def main() -> int:
    """Run the server; return the exit code."""
    chosen = _arguments()
    condition = CircleCondition(chosen.plane, chosen.radius_mm, chosen.feed_mm_min, chosen.direction)
    try:
        server = _RtdeServer(
            _cobot(chosen.seed, chosen.watchdog_s),
            condition,
            host=chosen.host,
            port=chosen.port,
            repeat_forever=chosen.repeat_forever,
        )
    except DtwinError as error:
        sys.stderr.write(error.render() + "\n")
        return error.exit_code
    except OSError as error:
        sys.stderr.write(f"cannot listen on {chosen.host}:{chosen.port}: {error}\n")
        return 4
    realtime = chosen.realtime and _take_priority()
    ready = {"ready": True, "host": chosen.host, "port": server.port, "realtime": realtime}
    _say({**ready, "pid": os.getpid()})
    with contextlib.suppress(KeyboardInterrupt):
        server.run(sys.stdin.fileno() if chosen.control else None)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
