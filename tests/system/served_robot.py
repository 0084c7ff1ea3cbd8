"""``dtwin serve`` as a process with a promoted model, for the tests of what happens to it."""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from command_here import command_here
from virtual_robot import VirtualRobot

from dtwin.config import Home
from dtwin.serve.builder import GraphBuilder
from dtwin.serve.bundle import Bundle
from dtwin.serve.bundle_file import create_bundle, save_bundle
from dtwin.serve.interface import Input, Output, Provenance, SafetyLimits
from dtwin.serve.pointer import machine_folder, write_machine, write_pointer

MACHINE = "cobot-a"


def bundle(**changes: Any) -> Bundle:
    """First harmonic of the path angle; lenient about the timing of a busy test host."""
    g = GraphBuilder()
    angle = g.input("path_angle_rad")
    arguments: dict[str, Any] = {
        "name": "first-harmonic",
        "machine": MACHINE,
        "model_version": 3,
        "inputs": [Input("path_angle_rad", "rad", "path", 500.0, "path", -50.0, 50.0)],
        "outputs": [Output("radial_error_um", "path_radial")],
        "tick_graph": g.graph({"radial_error_um": 24.0 + 0.0 * g.apply("sin", angle)}),
        "safety": SafetyLimits(clamp_um=40.0, slew_um_s=2000.0, stale_s=0.3, trips_to_latch=9),
        "provenance": Provenance(evidence="virtual"),
    }
    return create_bundle(**(arguments | changes))


def promote(home: Home, state: str = "champion", **changes: Any) -> Path:
    made = bundle(**changes)
    path = machine_folder(MACHINE, home) / f"v{made.model_version}.json"
    save_bundle(made, path)
    write_pointer(MACHINE, home, path, made.model_version, state)  # type: ignore[arg-type]
    write_machine(MACHINE, home, {"type": "ur10e", "tcp_mm": [0.0, 0.0, 158.3]})
    return path


_STARTED: list[subprocess.Popen[str]] = []


def end_what_is_left() -> None:
    """End the servers that a failed test left behind: they would hold the robot's registers."""
    for process in _STARTED:
        if process.poll() is None:
            process.kill()
            process.communicate()
    _STARTED.clear()


class Server:
    """One ``dtwin serve`` process."""

    def __init__(self, *options: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "dtwin", "serve", "--priority=0", *options],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        _STARTED.append(self.process)
        self.said = ""

    def wait_for(self, words: str, timeout_s: float = 300.0) -> None:
        assert self.process.stderr is not None
        until = time.monotonic() + timeout_s
        while words not in self.said:
            ready, _, _ = select.select([self.process.stderr], [], [], until - time.monotonic())
            assert ready, f"never said {words!r}: {self.said}"
            received = os.read(self.process.stderr.fileno(), 65536).decode()
            assert received, f"ended without {words!r}: {self.said}"
            self.said += received

    def interrupt(self) -> None:
        self.process.send_signal(signal.SIGINT)

    def end(self) -> tuple[int, str, str]:
        out, err = self.process.communicate(timeout=600)
        return self.process.returncode, out, self.said + err


def served(*options: str) -> tuple[int, dict[str, Any], str]:
    """Exit code, answer and announcements of a command that serves for a time, in this process."""
    code, out, err = command_here("serve", "--priority=0", "--json", *options)
    return code, json.loads(out), err


def refused(*options: str) -> tuple[int, dict[str, Any]]:
    """Exit code and answer of a command that ends before it serves, in this process."""
    code, out, err = command_here("serve", "--priority=0", "--json", *options)
    assert code != 0, err
    return code, json.loads(out)


def applied_um(robot: VirtualRobot) -> float:
    return float(max(abs(x) for x in robot.do("status")["applied_um"]))


def wait_until_corrected(robot: VirtualRobot) -> None:
    until = time.monotonic() + 300.0
    while applied_um(robot) < 15.0:
        ended = [p.communicate() for p in _STARTED if p.poll() not in (None, 0)]
        assert time.monotonic() < until, ended
        time.sleep(0.02)


def wait_until_released(robot: VirtualRobot) -> None:
    until = time.monotonic() + 300.0
    while applied_um(robot) > 0.5:
        assert time.monotonic() < until
        time.sleep(0.02)


def logged(home: Home) -> list[dict[str, Any]]:
    lines = (home.logs / f"serve-{MACHINE}.jsonl").read_text().splitlines()
    return [json.loads(line) for line in lines]


def events(home: Home) -> list[dict[str, Any]]:
    lines = (home.logs / f"serve-{MACHINE}.events.jsonl").read_text().splitlines()
    return [json.loads(line) for line in lines]


def noted(home: Home, event: str) -> list[dict[str, Any]]:
    return [line for line in events(home) if line["event"] == event]


def wait_for(holds: Callable[[], bool], what: str) -> None:
    until_s = time.monotonic() + 300.0
    while not holds():
        assert time.monotonic() < until_s, what
        time.sleep(0.02)
