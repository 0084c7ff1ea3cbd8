"""The machines' ends of the freezes: what serves them, and what they held, by their own clock."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

from simulated_analogue_board import AnalogueBoard

from dtwin.config import Home
from dtwin.errors import DeviceError
from dtwin.links.analogue_calibration import _AxisFit, save
from dtwin.links.linuxcnc import Bridge, LinuxcncLink
from dtwin.links.state_feed import _REQUIRED
from dtwin.links.virtual_key import proof
from dtwin.machines.axis_server import AxisServer
from dtwin.machines.linuxcnc.instance import LinuxcncSession
from dtwin.schema import Floats
from dtwin.serve.builder import GraphBuilder
from dtwin.serve.bundle import Bundle
from dtwin.serve.bundle_file import create_bundle, save_bundle
from dtwin.serve.decision import Decision
from dtwin.serve.interface import Input, Output, Provenance, SafetyLimits
from dtwin.serve.loop import ServingLoop
from dtwin.serve.pointer import machine_folder, write_machine, write_pointer
from dtwin.serve.runtime import CompiledBundle

MACHINE = "frozen"
SLEW_UM_S = 2000.0
WANTED_UM = 100.0
# As much of it as LinuxCNC's component lets through.
LINUXCNC_UM = 50.0
UM_PER_V, NEUTRAL_V, CLOCK_HZ = 25.0, 5.0, 16e6
# A second of the axis control is two hundred ticks, of the feed as many states.
AXIS_PERIOD_S, FEED_PERIOD_S = 0.005, 0.005
_AXIS_TICKS = 1_000_000
_RUN = str(Path(__file__).with_name("run.py"))


@dataclass(frozen=True)
class Held:
    """What a machine's end held.

    Attributes:
        t_s: Its own clock. Shape (n,).
        value_um: The correction in force. Shape (n, 3).
        own: Whether its own watchdog was leading it to zero. Shape (n,).
        zeros: Whether zero was asked for, or nothing. Shape (n,).
    """

    t_s: Floats
    value_um: Floats
    own: np.ndarray
    zeros: np.ndarray


class End(Protocol):
    """A machine's end that is served by a process."""

    period_s: float
    quantum_um: float

    def processes(self) -> dict[str, list[int]]:
        """Return what can be frozen, by name: process ids."""
        ...

    def corrected(self) -> bool:
        """Tell whether the correction is there as a whole."""
        ...

    def held(self) -> Held:
        """Return what was held since the call before."""
        ...


def promote(home: Home, frame: str, evidence: str) -> Bundle:
    """Make a champion that always wants the same correction, and return it."""
    g = GraphBuilder()
    graph = g.graph({"offset_um": WANTED_UM + 0.0 * g.input("speed_scaling")})
    bundle = create_bundle(
        name="constant",
        machine=MACHINE,
        model_version=1,
        inputs=[Input("speed_scaling", "1", "none", 500.0, "controller", -1.0, 20.0)],
        outputs=[Output("offset_um", frame, "correction")],
        tick_graph=graph,
        safety=SafetyLimits(clamp_um=120.0, slew_um_s=SLEW_UM_S, trips_to_latch=10**6),
        provenance=Provenance(evidence=evidence),
    )
    path = save_bundle(bundle, machine_folder(MACHINE, home) / "v0001.json")
    write_machine(MACHINE, home, {"type": "ur10e", "tcp_mm": [0.0, 0.0, 158.3]})
    write_pointer(MACHINE, home, path, 1, "champion")
    return bundle


@contextlib.contextmanager
def serving(home: Home, *options: str) -> Iterator[subprocess.Popen[bytes]]:
    """Run ``dtwin serve`` until the block ends."""
    log = (home.root / "serve.log").open("ab")
    process = subprocess.Popen(
        [sys.executable, "-m", "dtwin", "serve", "--priority=0", "--patience=600", *options],
        env=dict(os.environ, DTWIN_HOME=str(home.root)),
        stdout=log,
        stderr=log,
    )
    try:
        yield process
    finally:
        process.terminate()
        process.wait(60)
        log.close()


def children(pid: int, module: str) -> list[int]:
    """Return the children of a process that run a module."""
    text = Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="ascii")
    named = {int(w): Path(f"/proc/{w}/cmdline").read_text(encoding="utf-8") for w in text.split()}
    return [child for child, line in named.items() if module in line]


class RobotEnd:
    """The virtual controller behind RTDE, with its own watchdog of 12 ms; its program's tick log."""

    period_s, quantum_um = 0.002, 0.0
    _WATCH_TICKS = 6

    def __init__(self, folder: Path, process: subprocess.Popen[bytes], robot: subprocess.Popen[str]) -> None:
        self._folder, self._process, self._robot = folder, process, robot
        self._seen = -1

    def _do(self, action: str, **more: object) -> dict[str, object]:
        assert self._robot.stdin is not None
        assert self._robot.stdout is not None
        self._robot.stdin.write(json.dumps({"do": action, **more}) + "\n")
        self._robot.stdin.flush()
        return dict(json.loads(self._robot.stdout.readline()))

    def processes(self) -> dict[str, list[int]]:
        loop = self._process.pid
        driver = children(loop, "ur_worker")
        return {"loop": [loop], "driver": driver, "loop and driver": [loop, *driver], "controller": [self._robot.pid]}

    def corrected(self) -> bool:
        return float(np.linalg.norm(self._do("status")["applied_um"])) > WANTED_UM - 1.0

    def held(self) -> Held:
        path = self._folder / "log.npz"
        self._do("offset_log", path=str(path))
        with np.load(path) as log:
            tick, number = log["tick"], log["sequence"]
            value_um, received_um = log["commanded_um"], log["received_um"]
        changed = np.diff(number, prepend=number[0]) != 0
        place = np.arange(len(tick))
        since = place - np.maximum.accumulate(np.where(changed, place, 0))
        zeros = changed & ~received_um.any(axis=1)
        dropped, own = False, np.zeros(len(tick), dtype=bool)
        for k in range(1, len(tick)):
            dropped = (dropped or since[k] >= self._WATCH_TICKS) and not zeros[k]
            # What it dropped it leads to zero at its own pace, whoever is back meanwhile.
            own[k] = dropped or (own[k - 1] and value_um[k - 1].any())
        new = tick >= self._seen
        self._seen = int(tick[-1])
        asked = received_um[new].any(axis=1)
        return Held(tick[new] * self.period_s, value_um[new], own[new], ~asked)


@contextlib.contextmanager
def robot_end(home: Home) -> Iterator[End]:
    promote(home, "base_x", "virtual")
    host = f"127.{30 + os.getpid() % 200}.{os.getpid() // 200 % 250}.77"
    robot = subprocess.Popen(
        # One turn takes half an hour, so that no program ends in between.
        [
            sys.executable,
            "-m",
            "studies.machines.rtde_server",
            f"--host={host}",
            "--control",
            "--repeat-forever",
            "--radius-mm=300",
            "--feed-mm-min=60",
            "--realtime",
        ],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert robot.stdout is not None
    assert robot.stdin is not None
    robot.stdout.readline()
    try:
        with serving(home, f"--host={host}") as process:
            yield RobotEnd(home.root, process, robot)
    finally:
        robot.stdin.close()
        robot.wait(10)


class Sledge:
    """An axis whose offsets are kept where another process reads them."""

    name, period_s, axes, provides, channels_hz = "sledge", AXIS_PERIOD_S, ("x",), (), 0.0
    ticks = _AXIS_TICKS

    def __init__(self, rows: np.memmap) -> None:
        self._rows, self.server = rows, None

    def state(self, tick: int) -> dict[str, float]:
        return {}

    def advance(self, tick: int, offset_um: Floats) -> None:
        assert self.server is not None
        self._rows[tick + 1] = [offset_um[0], float(self.server._let_go), 1.0]
        self._rows[0, 0] = tick


class AxisEnd:
    """The virtual axis control, with its watchdog of 100 ms; what its axis held tick by tick."""

    period_s, quantum_um = AXIS_PERIOD_S, 0.0

    def __init__(self, process: subprocess.Popen[bytes], control: subprocess.Popen[str], rows: np.memmap) -> None:
        self._process, self._control, self._rows, self._seen = process, control, rows, 0

    def processes(self) -> dict[str, list[int]]:
        loop, control = self._process.pid, self._control.pid
        return {"loop": [loop], "control": [control], "loop and control": [loop, control]}

    def corrected(self) -> bool:
        return bool(self._rows[int(self._rows[0, 0]) + 1, 0] > WANTED_UM - 1.0)

    def held(self) -> Held:
        first, last = self._seen, int(self._rows[0, 0])
        self._seen = last
        rows = np.array(self._rows[first + 1 : last + 2])
        value_um = np.zeros((len(rows), 3))
        value_um[:, 0] = rows[:, 0]
        t_s = (first + np.arange(len(rows))) * self.period_s
        return Held(t_s, value_um, rows[:, 1] > 0.5, rows[:, 0] == 0.0)


def axis_control(home: Home, clock: str) -> None:
    """Be the axis control, until somebody ends this process."""
    rows = _axis_rows(home, "r+")
    sledge = Sledge(rows)
    server = AxisServer(sledge, lambda nonce: proof(home, nonce), clock=clock)  # type: ignore[arg-type]
    sledge.server = server  # type: ignore[assignment]
    print(server.port, flush=True)
    server.run(lambda line: None, lambda done, total, what: None)


def _axis_rows(home: Home, mode: str) -> np.memmap:
    return np.memmap(home.root / "axis.rows", np.float64, mode, shape=(_AXIS_TICKS + 2, 3))


@contextlib.contextmanager
def axis_end(home: Home, clock: str) -> Iterator[End]:
    promote(home, "base_x", "virtual")
    rows = _axis_rows(home, "w+")
    control = subprocess.Popen(
        [sys.executable, _RUN, "--axis-control", clock, "--home", str(home.root)], stdout=subprocess.PIPE, text=True
    )
    assert control.stdout is not None
    port = int(control.stdout.readline())
    try:
        with serving(home, "--link=axes", f"--states=127.0.0.1:{port}") as process:
            yield AxisEnd(process, control, rows)
            if clock == "machine":
                # It waits for its client: a client that ends first is told to.
                process.terminate()
    finally:
        control.kill()
        control.wait()


class Feed:
    """States of a control that stands at one place, as a bridge beside it would send them."""

    def __init__(self) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listener.getsockname()[1])
        self._ended = threading.Event()
        threading.Thread(target=self._serve, daemon=True).start()

    def close(self) -> None:
        self._ended.set()
        self._listener.close()

    def _serve(self) -> None:
        still = dict.fromkeys(_REQUIRED, 0.0) | {"runtime_running": 1.0, "safety_ok": 1.0, "direction_sign": 1.0}
        with contextlib.suppress(OSError):
            while not self._ended.is_set():
                client, _ = self._listener.accept()
                with client, contextlib.suppress(OSError):
                    while not self._ended.wait(FEED_PERIOD_S):
                        line = json.dumps(still | {"timestamp_s": time.monotonic()})
                        client.sendall(line.encode() + b"\n")


class BoardEnd:
    """The real firmware in simavr with a watchdog of 100 ms; its voltages by its own clock."""

    period_s, quantum_um = FEED_PERIOD_S, 2.0 * UM_PER_V * 10.0 / 65536

    def __init__(self, process: subprocess.Popen[bytes], board: AnalogueBoard) -> None:
        self._process, self._board, self._seen = process, board, 0

    def processes(self) -> dict[str, list[int]]:
        loop, board = self._process.pid, self._board.process_id
        return {"loop": [loop], "board": [board], "loop and board": [loop, board]}

    def corrected(self) -> bool:
        return (self._board.volts()[0] - NEUTRAL_V) * UM_PER_V > WANTED_UM - 1.0

    def held(self) -> Held:
        n = len(self._board.changed_to)
        first, self._seen = max(self._seen - 1, 0), n
        volts = np.array(self._board.changed_to[first:n]).reshape(-1, 3)
        value_um = (volts - NEUTRAL_V) * UM_PER_V
        # Neutral in one step: that is the board's own doing, and the host engages it anew.
        own = np.abs(value_um).max(axis=1) < 0.1 if len(value_um) else np.zeros(0, dtype=bool)
        return Held(np.array(self._board.changes[first:n]) / CLOCK_HZ, value_um, own, own)


@contextlib.contextmanager
def board_end(home: Home) -> Iterator[End]:
    promote(home, "base_x", "real")
    save(home.root / "analogue.json", {a: _AxisFit(UM_PER_V, NEUTRAL_V, 0.01, 0.001, 0.05, {}, 5) for a in "xyz"})
    feed = Feed()
    try:
        with (
            AnalogueBoard(home.root) as board,
            serving(
                home,
                "--link=analogue",
                f"--port={board.port}",
                f"--states=127.0.0.1:{feed.port}",
                f"--states-hz={1.0 / FEED_PERIOD_S:g}",
                f"--calibration={home.root / 'analogue.json'}",
            ) as process,
        ):
            yield BoardEnd(process, board)
    finally:
        feed.close()


class LinuxcncEnd:
    """The real LinuxCNC with a watchdog of 50 ms; its sampler's record of the axes' offsets."""

    # Its component limits to a speed of its own, in cycles of 1 ms.
    period_s, quantum_um = 0.002, 0.05

    def __init__(self, client: subprocess.Popen[bytes], bridge: Bridge, folder: Path) -> None:
        self._client, self._bridge, self._folder = client, bridge, folder
        self._bridge.ask(do="record", file="freezes.txt")

    def processes(self) -> dict[str, list[int]]:
        return {"loop": [self._client.pid]}

    def corrected(self) -> bool:
        found = self._bridge.ask(do="wait", cycles=1, timeout_s=5.0)["state"]
        return found is not None and 1e3 * found["applied_mm"][0] > LINUXCNC_UM - 1.0

    def held(self) -> Held:
        self._bridge.ask(do="stop_record")
        rows = [line.split() for line in (self._folder / "freezes.txt").open("rb")]
        self._bridge.ask(do="record", file="freezes.txt")
        samples = np.array([row for row in rows if len(row) == 13], dtype=float)
        value_um = 1e3 * samples[:, 9:12]
        # Its own ramp is told by its speed: 4 um in a cycle, and towards zero.
        length = np.linalg.norm(value_um, axis=1)
        own = np.diff(length, prepend=length[0]) < 0.0
        return Held(1e-3 * samples[:, 0], value_um, own, own)


def linuxcnc_client(home: Home, path: Path) -> None:
    """Serve a LinuxCNC until somebody ends this process."""
    bundle = promote(home, "base_x", "virtual")
    decision = Decision(CompiledBundle(bundle), np.zeros(3))
    with Bridge(path) as bridge:
        ServingLoop(decision, LinuxcncLink(bridge)).run(1e6, priority=0)


@contextlib.contextmanager
def linuxcnc_end(home: Home) -> Iterator[End]:
    with LinuxcncSession() as session, Bridge(session.socket_path) as bridge:
        client = subprocess.Popen(
            [sys.executable, _RUN, "--linuxcnc-client", str(session.socket_path), "--home", str(home.root)]
        )
        try:
            yield LinuxcncEnd(client, bridge, session.folder)
        finally:
            client.kill()
            client.wait()
            with contextlib.suppress(DeviceError):
                bridge.ask(do="stop_record")
