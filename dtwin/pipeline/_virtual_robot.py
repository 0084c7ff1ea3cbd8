"""The virtual controller as a process on loopback, speaking real RTDE."""

from __future__ import annotations

import contextlib
import json
import os
import select
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from dtwin.errors import DeviceError
from dtwin.links.ur_worker import RTDE_PORT
from dtwin.processes import end_child

_START_S = 60.0


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
def virtual_controller(
    *, plane: str = "XY", radius_mm: float = 100.0, feed_mm_min: float = 3000.0, seed: int = 0, log: Path | None = None
) -> Iterator[str]:
    """Run the virtual controller while the body runs, and give its address.

    ``plane``, ``radius_mm``, ``feed_mm_min``: circle that it runs again and again.
    """
    host = _free_address()
    command = [
        sys.executable,
        "-m",
        "dtwin.machines.rtde_server",
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
