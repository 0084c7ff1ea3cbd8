"""A virtual robot in a process of its own, for the tests of what talks to it."""

from __future__ import annotations

import itertools
import json
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

RTDE_PORT = 30004
_COUNT = itertools.count(1)


def free_address() -> str:
    """A loopback address of this process whose RTDE port is free; clients cannot choose ports."""
    while True:
        address = f"127.{20 + os.getpid() % 200}.{os.getpid() // 200 % 250}.{next(_COUNT)}"
        with socket.socket() as probe:
            try:
                probe.bind((address, RTDE_PORT))
            except OSError:
                continue
            return address


class VirtualRobot:
    """Handle of the server process."""

    def __init__(self, host: str, process: subprocess.Popen[str]) -> None:
        self.host = host
        self.process = process

    def do(self, action: str, **arguments: Any) -> dict[str, Any]:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(json.dumps({"do": action, **arguments}) + "\n")
        self.process.stdin.flush()
        return dict(json.loads(self.process.stdout.readline()))


@contextmanager
def virtual_robot(*options: str, watchdog_s: float | None = 0.05, host: str = "") -> Iterator[VirtualRobot]:
    """Run one; its watchdog is patient with a busy test computer, None leaves its own."""
    host = host or free_address()
    command = [sys.executable, "-m", "studies.machines.rtde_server", f"--host={host}"]
    process = subprocess.Popen(
        [
            *command,
            "--repeat-forever",
            "--control",
            *([] if watchdog_s is None else [f"--watchdog-s={watchdog_s}"]),
            *options,
        ],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout is not None
        assert json.loads(process.stdout.readline())["ready"]
        yield VirtualRobot(host, process)
    finally:
        process.stdin.close()  # type: ignore[union-attr]
        process.wait(300)
        process.stdout.close()  # type: ignore[union-attr]
