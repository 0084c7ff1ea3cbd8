"""A device at the other end of a pseudo-terminal, sending what a test wants."""

from __future__ import annotations

import os
import pty
import struct
import threading
import tty
from collections.abc import Iterator
from contextlib import contextmanager

from dtwin.links.serial_line import _encode


class SerialPeer:
    """Handle of the far end."""

    def __init__(self) -> None:
        self.master, slave = pty.openpty()
        tty.setraw(slave)
        self.port = os.ttyname(slave)
        # Held open, or the line would count as hung up while nobody has opened the port.
        self.slave = slave
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None

    def send(self, *values: float, sequence: int) -> None:
        self.raw(_encode(sequence, struct.pack(f"<{len(values)}f", *values)))

    def raw(self, data: bytes) -> None:
        os.write(self.master, data)

    def stream(self, columns: int, rate_hz: float) -> None:
        """Send counting samples from now on."""

        def run() -> None:
            sequence = 0
            while not self._ended.wait(1.0 / rate_hz):
                self.send(*[float(sequence)] * columns, sequence=sequence)
                sequence = (sequence + 1) % 65536

        self._thread = threading.Thread(target=run, daemon=True)
        self._thread.start()

    def hang_up(self) -> None:
        self._ended.set()
        if self._thread is not None:
            self._thread.join(5)
        for descriptor in (self.master, self.slave):
            if descriptor >= 0:
                os.close(descriptor)
        self.master = self.slave = -1


@contextmanager
def serial_peer() -> Iterator[SerialPeer]:
    peer = SerialPeer()
    try:
        yield peer
    finally:
        peer.hang_up()
