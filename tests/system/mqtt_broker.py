"""A real broker on loopback."""

from __future__ import annotations

import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from conftest import require_program


@contextmanager
def running_broker(folder: Path, port: int = 0, started: list[subprocess.Popen[bytes]] | None = None) -> Iterator[int]:
    """Yield the port of a mosquitto; a given one is taken again. Its process is added to ``started``."""
    program = require_program("mosquitto", "mosquitto", "/usr/sbin")
    if not port:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = int(free.getsockname()[1])
    settings = folder / "mosquitto.conf"
    settings.write_text(f"listener {port} 127.0.0.1\nallow_anonymous true\n", encoding="utf-8")
    with subprocess.Popen([program, "-c", str(settings)], stderr=subprocess.DEVNULL) as process:
        if started is not None:
            started.append(process)
        until = time.monotonic() + 300.0
        while True:
            try:
                socket.create_connection(("127.0.0.1", port), 1.0).close()
                break
            except OSError:
                assert time.monotonic() < until
                time.sleep(0.05)
        try:
            yield port
        finally:
            process.terminate()
