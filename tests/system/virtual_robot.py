"""A virtual robot in a process of its own, for the tests of what talks to it."""

from __future__ import annotations

import itertools
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from commanded import Commanded, started

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


class VirtualRobot(Commanded):
    """Handle of the server process."""

    def __init__(self, host: str, process: subprocess.Popen[str]) -> None:
        super().__init__(process)
        assert self.said["ready"]
        self.host = host


@contextmanager
def virtual_robot(*options: str, watchdog_s: float | None = 0.05, host: str = "") -> Iterator[VirtualRobot]:
    """Run one; its watchdog is patient with a busy test computer, None leaves its own."""
    host = host or free_address()
    watchdog = [] if watchdog_s is None else [f"--watchdog-s={watchdog_s}"]
    command = [sys.executable, "-m", "dtwin.machines.rtde_server", f"--host={host}", "--repeat-forever", "--control"]
    with started([*command, *watchdog, *options]) as process:
        yield VirtualRobot(host, process)
