"""A virtual acquisition chassis in a process of its own, behind a loopback gRPC server."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


class VirtualDaq:
    """Handle of the server process."""

    def __init__(self, port: int, process: subprocess.Popen[str]) -> None:
        self.target = f"127.0.0.1:{port}"
        self.process = process

    def do(self, action: str, **arguments: Any) -> dict[str, Any]:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(json.dumps({"do": action, **arguments}) + "\n")
        self.process.stdin.flush()
        return dict(json.loads(self.process.stdout.readline()))


@contextmanager
def virtual_daq(*options: str) -> Iterator[VirtualDaq]:
    process = subprocess.Popen(
        [sys.executable, "-m", "studies.machines.daq_server", "--port=0", "--control", *options],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout is not None
        yield VirtualDaq(json.loads(process.stdout.readline())["port"], process)
    finally:
        process.stdin.close()  # type: ignore[union-attr]
        process.wait(300)
        process.stdout.close()  # type: ignore[union-attr]
