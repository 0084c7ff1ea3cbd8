"""A short time of serving to the virtual controller, on the wall clock."""

from __future__ import annotations

import contextlib
import json
import os
import select
import socket
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from dtwin.config import Home
from dtwin.errors import DeviceError
from dtwin.links.ur_worker import RTDE_PORT
from dtwin.processes import end_child
from dtwin.units import shown_number

Circle = tuple[str, float, float]
"""Plane, radius in mm, feed in mm/min."""
_START_S = 60.0


def serve_wall_clock(home: Home, machine: str, circle: Circle, duration_s: float, seed: int) -> dict[str, Any]:
    """Serve the trial to the virtual controller over real RTDE, on the wall clock.

    Serving runs in a process of its own, as it would beside a machine: no other thread may
    hold its interpreter.

    ``circle``: plane, radius in mm and feed in mm/min that the robot runs.
    ``duration_s``: for how long, in s.
    Returns what ``dtwin serve --json`` printed.
    Raises ``DeviceError`` when the process printed no status.
    """
    plane, radius, feed = circle
    log = home.logs / "virtual-controller.log"
    with _virtual_controller(plane=plane, radius_mm=radius, feed_mm_min=feed, seed=seed, log=log) as host:
        done = subprocess.run(
            [
                *(sys.executable, "-P", "-m", "dtwin", "serve", "--model", "trial"),
                *("--machine", machine, "--host", host, "--duration", str(duration_s), "--json"),
            ],
            env=dict(os.environ, DTWIN_HOME=str(home.root)),
            capture_output=True,
            text=True,
            check=False,
        )
    try:
        figures: dict[str, Any] = json.loads(done.stdout)
    except ValueError as error:
        raise DeviceError(
            "serving printed no status", code="demo.serve", got=done.stderr[-400:] or "nothing"
        ) from error
    return figures


def serving_numbers(serving: Mapping[str, Any]) -> list[list[str]]:
    """Return the rows (what, value) of a serving status, as ``dtwin serve --json`` prints it."""
    if "timing" not in serving:
        return [["error", str(serving.get("error", serving))[:200]]]
    rows = [
        ["ended", str(serving["ended"])],
        ["corrections sent", str(serving["last_sequence"])],
        ["correction released", "yes" if serving["released"] else "no"],
    ]
    for name, value in serving["timing"].items():
        if isinstance(value, Mapping) and "p50" in value:
            shown = ", ".join(f"{k} {shown_number(v, 4)}" for k, v in value.items() if isinstance(v, float))
            rows.append([name, shown])
        elif isinstance(value, int | float):
            rows.append([name, shown_number(value, 4)])
    rows += [[f"real time: {k}", v] for k, v in serving["realtime"].items()]
    return rows


def _free_address() -> str:
    """Return a loopback address whose RTDE port is free; UR clients cannot choose the port."""
    start = os.getpid()
    for count in range(100):
        number = start + count
        address = f"127.{10 + number % 200}.{number // 200 % 250}.{1 + count}"
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.bind((address, RTDE_PORT))
            return address
    raise DeviceError("no free loopback address for the virtual robot", code="virtual.address")


@contextlib.contextmanager
def _virtual_controller(
    *, plane: str = "XY", radius_mm: float = 100.0, feed_mm_min: float = 3000.0, seed: int = 0, log: Path | None = None
) -> Iterator[str]:
    """Run the virtual controller while the body runs, and give its address.

    ``plane``, ``radius_mm``, ``feed_mm_min``: circle that it runs again and again.
    """
    host = _free_address()
    command = [
        sys.executable,
        "-P",
        "-m",
        "studies.machines.rtde_server",
        f"--host={host}",
        f"--plane={plane}",
        f"--radius-mm={radius_mm}",
        f"--feed-mm-min={feed_mm_min}",
        f"--seed={seed}",
        "--direction=CCW",
        "--repeat-forever",
        "--control",
        "--realtime",
    ]
    if log is not None:
        log.parent.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as stack:
        errors = stack.enter_context(log.open("ab")) if log is not None else subprocess.DEVNULL
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors, text=True)
        try:
            _await_ready(process)
            yield host
        finally:
            end_child(process, 10.0)
            if process.stdout is not None:
                process.stdout.close()


def _await_ready(process: subprocess.Popen[str]) -> None:
    if process.stdout is None:
        return
    ready, _, _ = select.select([process.stdout], [], [], _START_S)
    line = process.stdout.readline() if ready else ""
    with contextlib.suppress(ValueError):
        if json.loads(line or "{}").get("ready"):
            return
    raise DeviceError("the virtual robot did not start", code="virtual.start", got=line[:120] or "no answer")
