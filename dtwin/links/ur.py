"""Link to a Universal Robots controller, through a supervised driver process.

The driver process (``dtwin.links.ur_worker``) owns the real ``ur_rtde`` interfaces. States and
corrections cross over shared memory; a descriptor wakes the waiting side. Whatever happens to
the driver or to the robot, the host gets a ``DeviceError``.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import subprocess
import sys
import tempfile
import time
from typing import IO, Any

import numpy as np

from dtwin.errors import DeviceError, InputError
from dtwin.links import layout
from dtwin.links._ur_memory import SharedMemory
from dtwin.links.opened import Closed
from dtwin.processes import end_child

_CLOSE_S = 2.0
# Beyond the driver's own limit of silence: it should have spoken.
_STUCK_S = 1.0
_HINTS = {
    "ur.absent": "switch the robot on, check address and cable, and that RTDE (port 30004) is on",
    "ur.package": "pip install '.[serve]' in a checkout of dtwin",
    "ur.protocol": "check the address; of a robot: update PolyScope",
    "ur.variables": "update PolyScope",
    "ur.refused": "update PolyScope, and see the controller's log",
    "ur.registers_owned": "end the other client: a second dtwin, a fieldbus (EtherNet/IP, "
    "PROFINET, MODBUS), or a link that the controller has not yet noticed to be dead",
    "ur.link_lost": "check cable and controller, then connect again",
    "ur.silent": "check whether the controller is overloaded or paused, then connect again",
}


class UrLink(Closed):
    """States from a robot controller, corrections to it.

    Args:
        connect_timeout_s: How long to wait for the controller.
        lost_after_s: Silence after which the link counts as broken.
        realtime: Ask for real-time priority of the driver; ``self.realtime`` tells whether it was given.
        writes: Claim the input registers; false for a link that only listens.

    Raises:
        DeviceError: When no controller answers in time.
        InputError: When the frequency makes no sense.
    """

    def __init__(
        self,
        host: str,
        frequency_hz: float = 500.0,
        *,
        connect_timeout_s: float = 5.0,
        lost_after_s: float = 2.0,
        realtime: bool = True,
        writes: bool = True,
    ) -> None:
        if not 1.0 <= frequency_hz <= 500.0:
            raise InputError(
                "the controller cannot send at this rate",
                code="ur.frequency",
                got=f"{frequency_hz} Hz",
                allowed="1 to 500 Hz",
            )
        self.host = host
        self.realtime = False
        self._lost_after_s, self._heard_s = lost_after_s, time.monotonic()
        self._writes = writes
        self._fault: DeviceError | None = None
        self._closed = False
        self._memory_file = SharedMemory.create()
        self._memory = SharedMemory(self._memory_file)
        flags = os.EFD_NONBLOCK | os.EFD_CLOEXEC
        self._state_ready, self._correction_ready = os.eventfd(0, flags), os.eventfd(0, flags)
        self._messages, child_messages = os.pipe2(os.O_CLOEXEC)
        self._held = b""
        self._buffer = np.zeros(layout.N + 1)
        self._seen = 0
        self._errors: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115
        descriptors = {
            "memory": self._memory_file,
            "state-ready": self._state_ready,
            "correction-ready": self._correction_ready,
            "messages": child_messages,
        }
        options = [f"--{name}={number}" for name, number in descriptors.items()]
        options += [f"--host={host}", f"--frequency-hz={frequency_hz}"]
        options += [f"--lost-after-s={lost_after_s}"] + (["--realtime"] if realtime else [])
        options += ["--writes"] if writes else []
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "dtwin.links.ur_worker", *options],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=self._errors,
            pass_fds=tuple(descriptors.values()),
            start_new_session=True,
        )
        os.close(child_messages)
        self._await_connection(connect_timeout_s)

    @property
    def alive(self) -> bool:
        """Whether the driver runs and has reported no fault."""
        return not self._closed and self._fault is None and self._process.poll() is None

    @property
    def received_s(self) -> float:
        """Monotonic time at which the driver saw the newest state that was returned."""
        return float(self._buffer[layout.N])

    @property
    def process_id(self) -> int:
        """Process id of the driver."""
        return self._process.pid

    @property
    def newest(self) -> layout.RobotState:
        """State (N,) that was returned last."""
        return self._buffer[: layout.N]

    def wait_state(self, timeout_s: float) -> layout.RobotState | None:
        """Return the newest state that was not returned before.

        Returns:
            The state, in a buffer that the next call overwrites; None when none came in time.

        Raises:
            DeviceError: When the link is broken, the driver died, or the link was closed.
        """
        self._require_open()
        deadline_s = time.monotonic() + timeout_s
        while True:
            number = self._memory.read_state(self._buffer)
            if number not in (0, self._seen):
                self._seen, self._heard_s = number, time.monotonic()
                return self._buffer[: layout.N]
            left_s = max(deadline_s - time.monotonic(), 0.0)
            ready, _, _ = select.select([self._state_ready, self._messages], [], [], left_s)
            if not ready:
                self._require_driver()
                return None
            if self._messages in ready:
                self._read_messages()
            if self._state_ready in ready:
                with contextlib.suppress(BlockingIOError):
                    os.eventfd_read(self._state_ready)

    def begin(self) -> None:
        """Nothing to do: the robot's program takes whatever has a new number."""

    def send(self, offset_um: layout.Floats, sequence: int) -> None:
        """Hand a correction to the driver, which sends it at once.

        Args:
            offset_um: Offset of the path along base x, y, z. Shape (3,).
            sequence: Must differ from the last one; 1 to ``SEQUENCE_LIMIT``.

        Raises:
            DeviceError: When the link is broken or closed.
            InputError: When an offset is not finite or the sequence number does not fit its register.
        """
        self._require_open()
        if not (np.isfinite(offset_um).all() and 0 < sequence <= layout.SEQUENCE_LIMIT):
            raise InputError(
                "a correction must be finite and numbered",
                code="ur.correction",
                got=f"{list(offset_um)}, sequence {sequence}",
                allowed=f"finite µm, sequence 1 to {layout.SEQUENCE_LIMIT}",
            )
        self._memory.write_correction(sequence, offset_um)
        os.eventfd_write(self._correction_ready, 1)

    def close(self) -> None:
        """Release the offset, end the driver, and free everything; safe to call twice."""
        if self._closed:
            return
        self._closed = True
        end_child(self._process, _CLOSE_S)
        for descriptor in (self._memory_file, self._state_ready, self._correction_ready, self._messages):
            os.close(descriptor)
        self._errors.close()

    def _require_open(self) -> None:
        if self._closed:
            raise DeviceError("the link to the robot is closed", code="ur.closed", where=self.host)
        if self._fault is not None:
            raise self._fault

    def _require_driver(self) -> None:
        """Raise when the driver has outstayed its own limit of silence without a word."""
        if time.monotonic() - self._heard_s > self._lost_after_s + _STUCK_S:
            self._process.kill()
            text = "the robot driver process hangs; it was ended"
            self._fault = self._error("ur.driver_stuck", text)
            raise self._fault

    def _await_connection(self, timeout_s: float) -> None:
        deadline_s = time.monotonic() + timeout_s
        message: dict[str, Any] | None = None
        try:
            while message is None:
                left_s = deadline_s - time.monotonic()
                ready, _, _ = select.select([self._messages], [], [], max(left_s, 0.0))
                if not ready:
                    text = f"no robot controller answered within {timeout_s:g} s"
                    raise self._error("ur.absent", text)
                message = self._read_messages()
        except BaseException:
            self._process.kill()
            self.close()
            raise
        self.realtime = bool(message.get("realtime"))

    def _read_messages(self) -> dict[str, Any] | None:
        """Return a message of the driver; raise what it reports, or its death."""
        received = os.read(self._messages, 65536)
        if not received:
            self._fault = self._death()
            raise self._fault
        self._held += received
        line, complete, rest = self._held.partition(b"\n")
        if not complete:
            return None
        self._held = rest
        message: dict[str, Any] = json.loads(line)
        if "fault" in message:
            self._fault = self._error(message["fault"], message["message"])
            raise self._fault
        return message

    def _death(self) -> DeviceError:
        try:
            code = self._process.wait(_CLOSE_S)
        except subprocess.TimeoutExpired:
            return self._error("ur.driver_died", "the robot driver stopped answering")
        self._errors.seek(0)
        said = self._errors.read().decode(errors="replace").strip().splitlines()
        how = f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
        last = f"; it said: {said[-1][:200]}" if said else ""
        return self._error("ur.driver_died", f"the robot driver process died ({how}){last}")

    def _error(self, code: str, message: str) -> DeviceError:
        hint = _HINTS.get(code, "connect again; the robot has led the offset back to zero")
        return DeviceError(message, code=code, where=f"robot at {self.host}", hint=hint)
