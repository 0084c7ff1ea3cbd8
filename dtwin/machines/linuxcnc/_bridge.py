"""Runs beside LinuxCNC under the system's Python, whose modules ``linuxcnc`` and ``hal`` need it.

Speaks lines of JSON over a Unix socket; knows nothing of dtwin. It is the first process of its own
namespaces: when it ends, because its owner closed its input or died, everything in them ends.
"""

import contextlib
import json
import os
import pathlib
import signal
import socket
import subprocess
import sys
import threading
import time
from typing import Any

_START_S = 30.0
_SERVO_S = 0.001
_COMMAND_S = 5.0
_AXES = "xyz"
_POLL_S = 1e-4
_CONTEXT = range(8)


class _Control:
    """LinuxCNC's task: power, homing, programs, messages."""

    def __init__(self, folder: pathlib.Path) -> None:
        import linuxcnc

        self.api, self.folder = linuxcnc, folder
        self.lock = threading.Lock()
        self.recorder: subprocess.Popen[bytes] | None = None
        self.messages: list[str] = []
        until_s = time.monotonic() + _START_S
        # A status that is made before the tool table is there never sees it.
        while not (folder / ".tool.mmap").exists() and time.monotonic() < until_s:
            time.sleep(0.02)
        while True:
            try:
                self.stat = linuxcnc.stat()
                self.stat.poll()
                break
            except linuxcnc.error:
                if time.monotonic() > until_s:
                    raise
                time.sleep(0.05)
        self.command, self.errors = linuxcnc.command(), linuxcnc.error_channel()

    def begin(self) -> None:
        """Switch the machine on and home it."""
        api, command = self.api, self.command
        for state in (api.STATE_ESTOP_RESET, api.STATE_ON):
            command.state(state)
            command.wait_complete(5.0)
        command.mode(api.MODE_MANUAL)
        command.wait_complete(5.0)
        command.home(-1)
        until_s = time.monotonic() + 10.0
        while not all(self.poll().homed[:3]):
            if time.monotonic() > until_s:
                raise RuntimeError("the axes do not home: " + "; ".join(self.messages))
            time.sleep(0.02)

    def poll(self) -> Any:
        """Return the newest status, and keep what the control reports."""
        self.stat.poll()
        while error := self.errors.poll():
            self.messages.append(str(error[1]))
        return self.stat

    def run(self, program: str) -> dict[str, Any]:
        """Start a program."""
        with self.lock:
            self.poll()
            self.messages.clear()
            self.tell("mode AUTO", lambda: self.command.mode(self.api.MODE_AUTO))
            self.tell("open", lambda: self.command.program_open(str(self.folder / program)))
            # Its completion is that of the whole program: it is only watched to begin.
            self.command.auto(self.api.AUTO_RUN, 0)
            until_s = time.monotonic() + _COMMAND_S
            while self.poll().interp_state == self.api.INTERP_IDLE:
                if self.messages or time.monotonic() > until_s:
                    raise RuntimeError("the program does not begin: " + "; ".join(self.messages))
                time.sleep(0.001)
        return self.status()

    def tell(self, what: str, command: Any) -> None:
        """Give a command and wait until it is done."""
        command()
        done = self.command.wait_complete(_COMMAND_S)
        if done != self.api.RCS_DONE:
            self.poll()
            told = "; ".join(self.messages) or f"LinuxCNC said {done}"
            raise RuntimeError(f"{what}: {told}")

    def status(self) -> dict[str, Any]:
        """Return whether a program runs, and what was reported."""
        with self.lock:
            stat = self.poll()
            idle = stat.interp_state == self.api.INTERP_IDLE and stat.inpos and stat.queue == 0
            # After a dwell all of this looks idle for a moment; the command itself is not done.
            # A command that failed says error until the next one is given.
            over = stat.state in (self.api.RCS_DONE, self.api.RCS_ERROR)
            done = stat.exec_state == self.api.EXEC_DONE and over
            return {"running": not (idle and done), "enabled": bool(stat.enabled), "messages": list(self.messages)}

    def record(self, file: str) -> dict[str, Any]:
        """Begin to write the sampler's stream; what it held from before is dropped."""
        import hal

        # Tags count from the first sample; those of now must not be mixed with old ones.
        depth = int(hal.get_value("sampler.0.curr-depth"))
        if depth:
            subprocess.run(["halsampler", "-n", str(depth)], stdout=subprocess.DEVNULL, check=True)
        with (self.folder / file).open("wb") as out:
            self.recorder = subprocess.Popen(["halsampler", "-t"], stdout=out)
        return {}

    def stop_record(self) -> dict[str, Any]:
        """End the recording."""
        time.sleep(0.05)
        if self.recorder is not None:
            self.recorder.send_signal(signal.SIGTERM)
            self.recorder.wait(5.0)
            self.recorder = None
        return {}


class _Registers:
    """The correction component and the state that serving needs; HAL's shared memory only."""

    def __init__(self) -> None:
        import hal

        self.hal = hal
        self.seen = 0

    def send(self, offset_um: list[float], sequence: int) -> None:
        """Write the three values, then the number that makes them count."""
        for axis, value in zip(_AXES, offset_um, strict=True):
            self.hal.set_p(f"correction.{axis}", repr(float(value)))
        self.hal.set_p("correction.sequence", str(int(sequence)))

    def wait(self, cycles: int, timeout_s: float) -> "dict[str, Any] | None":
        """Return the state when the servo thread has run so often since the last one."""
        until_s = time.monotonic() + timeout_s
        while True:
            now = int(self.hal.get_value("correction.cycles"))
            # The counter is 32 bits wide.
            if (now - self.seen) % 2**32 >= cycles:
                break
            if time.monotonic() > until_s:
                return None
            time.sleep(_POLL_S)
        self.seen = now
        get = self.hal.get_value
        return {
            "t_s": now * _SERVO_S,
            "position_mm": [get(f"joint.{j}.pos-cmd") for j in range(3)],
            "speed_mm_s": [get(f"joint.{j}.vel-cmd") for j in range(3)],
            "actual_mm": [get(f"joint.{j}.pos-fb") for j in range(3)],
            "applied_mm": [get(f"axis.{a}.eoffset") for a in _AXES],
            "context": [get(f"motion.analog-out-0{n}") for n in _CONTEXT],
            "latched": get("correction.latched"),
            "trips": get("correction.trips"),
            "enabled": bool(get("motion.motion-enabled")),
        }


def _answer(request: dict[str, Any], control: _Control, registers: _Registers) -> "dict[str, Any] | None":
    """Do what a line asks for; a correction is not answered."""
    what = request["do"]
    if what == "send":
        registers.send(request["offset_um"], request["sequence"])
        return None
    if what == "wait":
        return {"state": registers.wait(int(request["cycles"]), float(request["timeout_s"]))}
    if what == "status":
        return control.status()
    if what == "run":
        return control.run(request["program"])
    if what == "record":
        return control.record(request["file"])
    if what == "stop_record":
        return control.stop_record()
    if what == "get":
        return {"value": registers.hal.get_value(request["pin"])}
    if what == "set":
        registers.hal.set_p(request["pin"], repr(request["value"]))
        return {}
    raise ValueError(f"no such request: {what}")


def _serve(connection: socket.socket, control: _Control) -> None:
    """Answer one client until it goes away."""
    registers = _Registers()
    failed: dict[str, Any] | None = None
    with connection, connection.makefile("rwb") as stream, contextlib.suppress(OSError):
        for line in stream:
            sends = False
            try:
                request = json.loads(line)
                sends = request["do"] == "send"
                said = failed or _answer(request, control, registers)
            except Exception as error:
                said = {"error": f"{type(error).__name__}: {error}"}
            # A correction has no answer: that it failed is what the next request is told, once.
            failed = said if sends else None
            if not sends:
                stream.write(json.dumps(said).encode() + b"\n")
                stream.flush()


def _attach() -> Any:
    """Join HAL, which a process does once and in its main thread."""
    import hal

    component = hal.component("dtwin-bridge")
    component.ready()
    return component


def _end_with_owner() -> None:
    """End when the owner closes our input, which the system does when it dies."""
    sys.stdin.buffer.read()
    os._exit(0)


def main() -> None:
    """Start LinuxCNC in this folder and answer on ``bridge.sock``."""
    folder = pathlib.Path.cwd()
    threading.Thread(target=_end_with_owner, daemon=True).start()
    owner = os.fdopen(os.dup(1), "w")
    with (folder / "linuxcnc.log").open("wb") as log:
        # LinuxCNC's libraries print to this process's output, too.
        os.dup2(log.fileno(), 1)
        os.dup2(log.fileno(), 2)
    subprocess.Popen(["linuxcnc", "-r", "mill.ini"], stdin=subprocess.DEVNULL)
    try:
        control = _Control(folder)
        control.begin()
        component = _attach()
        listener = socket.socket(socket.AF_UNIX)
        listener.bind("bridge.sock")
        listener.listen(4)
    except Exception as error:
        print(json.dumps({"error": f"{type(error).__name__}: {error}"}), file=owner, flush=True)
        return
    print(json.dumps({"ready": True}), file=owner, flush=True)
    # The component has no pins and counts as false; it must outlive the loop.
    while component is not None:
        connection, _ = listener.accept()
        threading.Thread(target=_serve, args=(connection, control), daemon=True).start()


if __name__ == "__main__":
    main()
