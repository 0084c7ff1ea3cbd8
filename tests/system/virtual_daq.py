"""A virtual acquisition chassis in a process of its own, behind a loopback gRPC server."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from commanded import Commanded, started


class VirtualDaq(Commanded):
    """Handle of the server process."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        super().__init__(process)
        self.target = f"127.0.0.1:{self.said['port']}"


@contextmanager
def virtual_daq(*options: str) -> Iterator[VirtualDaq]:
    with started([sys.executable, "-m", "dtwin.machines.daq_server", "--port=0", "--control", *options]) as process:
        yield VirtualDaq(process)
