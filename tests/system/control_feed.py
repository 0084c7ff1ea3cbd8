"""A control that goes round a circle and tells its state, and a serial line that spoils bytes."""

from __future__ import annotations

import json
import math
import os
import select
import socket
import termios
import threading
import time
import tty
from types import TracebackType
from typing import Self

from dtwin.links.state_feed import _REQUIRED

RATE_HZ = 200.0
RADIUS_MM = 100.0
FEED_MM_MIN = 3000.0


class ControlFeed:
    """Serves states at ``RATE_HZ`` to one client after the other, until it is stopped."""

    def __init__(self, port: int = 0) -> None:
        self._listener = socket.create_server(("127.0.0.1", port))
        self._listener.settimeout(0.05)
        self.port = int(self._listener.getsockname()[1])
        self.address = f"127.0.0.1:{self.port}"
        self.changes: dict[str, float] = {}
        self.garbage = b""
        self.silent = False
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        self._thread.join(5.0)
        self._listener.close()

    def _serve(self) -> None:
        while not self._ended.is_set():
            try:
                client, _ = self._listener.accept()
            except TimeoutError:
                continue
            with client:
                client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._stream(client)

    def _stream(self, client: socket.socket) -> None:
        began_s = time.monotonic()
        tick = 0
        while not self._ended.is_set():
            tick += 1
            time.sleep(max(0.0, began_s + tick / RATE_HZ - time.monotonic()))
            if self.silent:
                continue
            line = self.garbage or json.dumps(self.state(time.monotonic())).encode()
            try:
                client.sendall(line + b"\n")
            except OSError:
                return

    def state(self, now_s: float) -> dict[str, float]:
        speed = FEED_MM_MIN / 60.0
        angle = (now_s * speed / RADIUS_MM) % (2.0 * math.pi)
        state = dict.fromkeys(_REQUIRED, 0.0) | {
            "timestamp_s": now_s,
            "target_tcp_x_mm": RADIUS_MM * math.cos(angle),
            "target_tcp_y_mm": RADIUS_MM * math.sin(angle),
            "target_speed_x_mm_s": -speed * math.sin(angle),
            "target_speed_y_mm_s": speed * math.cos(angle),
            "runtime_running": 1.0,
            "safety_ok": 1.0,
            "radius_mm": RADIUS_MM,
            "direction_sign": 1.0,
            "feed_mm_min": FEED_MM_MIN,
        }
        return state | self.changes


class SpoilingLine:
    """A pseudo-terminal before another one, whose bytes can be cut and invented on the way."""

    def __init__(self, port: str) -> None:
        self._device = os.open(port, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(self._device, termios.TCSANOW)
        self._ours, theirs = os.openpty()
        tty.setraw(theirs, termios.TCSANOW)
        self._theirs = theirs
        self.port = os.ttyname(theirs)
        self.invent = b""
        self.cut = 0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._relay, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        self._thread.join(5.0)
        for descriptor in (self._device, self._ours, self._theirs):
            os.close(descriptor)

    def _relay(self) -> None:
        ways = {self._ours: self._device, self._device: self._ours}
        while not self._ended.is_set():
            for source in select.select(list(ways), [], [], 0.02)[0]:
                data = os.read(source, 4096)
                if self.cut:
                    data = data[: -self.cut]
                    self.cut = 0
                if self.invent:
                    data = self.invent + data
                    self.invent = b""
                os.write(ways[source], data)
