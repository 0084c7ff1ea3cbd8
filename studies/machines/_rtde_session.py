"""One RTDE client as the virtual controller sees it."""

from __future__ import annotations

import contextlib
import socket
import struct
from collections.abc import Callable

from dtwin.schema import Floats
from studies.machines import _rtde_protocol as rtde

_BACKLOG_LIMIT = 1 << 20


class Session:
    """Speaks RTDE over one accepted, non-blocking socket.

    ``connection``: accepted connection; owned by the session.
    ``on_input``: receives the name and value of every variable that the client writes, in order.
    ``owners``: who writes which input variable, common to all clients: one may write each.
    """

    def __init__(
        self,
        connection: socket.socket,
        rate_hz: float,
        on_input: Callable[[str, float], None],
        owners: dict[str, Session],
    ) -> None:
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.connection = connection
        self.open = True
        self._rate_hz = rate_hz
        self._on_input = on_input
        self._owners = owners
        self._reader = rtde.FrameReader()
        self._outputs: dict[int, rtde.OutputRecipe] = {}
        self._inputs: dict[int, rtde.InputRecipe] = {}
        self._streaming = False
        self._backlog = bytearray()

    def fileno(self) -> int:
        """Return the socket's descriptor, for ``select``."""
        return self.connection.fileno()

    def close(self) -> None:
        """Close the connection."""
        self.open = False
        for name in [name for name, owner in self._owners.items() if owner is self]:
            del self._owners[name]
        with contextlib.suppress(OSError):
            self.connection.close()

    def receive(self) -> None:
        """Read what has arrived and answer it; a client that talks nonsense is dropped."""
        try:
            received = self.connection.recv(65536)
        except BlockingIOError:
            return
        except OSError:
            received = b""
        if not received:
            self.close()
            return
        try:
            for kind, payload in self._reader.feed(received):
                self._answer(kind, payload)
        except (ValueError, KeyError, IndexError, UnicodeDecodeError, struct.error):
            self.close()

    def publish(self, tick: int, state: Floats, slowdown: int = 1) -> None:
        """Send the state to a streaming client, at the rate that it asked for."""
        if not self._streaming:
            return
        for recipe in self._outputs.values():
            if tick % (recipe.every * slowdown) == 0:
                self.send(recipe.data(state))

    def publish_half(self, state: Floats) -> None:
        """Send the first half of a data frame, as a cut connection would leave it."""
        if not self._streaming:
            return
        for recipe in self._outputs.values():
            whole = recipe.data(state)
            self.send(whole[: len(whole) // 2])

    def send(self, data: bytes) -> None:
        """Send without waiting; a client that reads too slowly is dropped."""
        self._backlog += data
        try:
            sent = self.connection.send(self._backlog)
            del self._backlog[:sent]
        except BlockingIOError:
            pass
        except OSError:
            self.close()
        if len(self._backlog) > _BACKLOG_LIMIT:
            self.close()

    def _answer(self, kind: int, payload: bytes) -> None:
        if kind == rtde.DATA:
            for name, value in self._inputs[payload[0]].values(payload[1:]).items():
                self._on_input(name, value)
        elif kind == rtde.REQUEST_VERSION:
            accepted = payload == b"\x00\x02"
            self.send(rtde.frame(kind, b"\x01" if accepted else b"\x00"))
        elif kind == rtde.CONTROLLER_VERSION:
            self.send(rtde.frame(kind, rtde.controller_version()))
        elif kind == rtde.SETUP_OUTPUTS:
            self._setup_outputs(payload)
        elif kind == rtde.SETUP_INPUTS:
            self._setup_inputs(payload)
        elif kind in (rtde.START, rtde.PAUSE):
            self._streaming = kind == rtde.START
            self.send(rtde.frame(kind, b"\x01"))
        elif kind != rtde.TEXT_MESSAGE:
            raise ValueError("unknown frame type")

    def _setup_outputs(self, payload: bytes) -> None:
        number = len(self._outputs) + 1
        recipe = rtde.output_recipe(number, payload, self._rate_hz)
        usable = "NOT_FOUND" not in recipe.types
        if usable:
            self._outputs[number] = recipe
        reply = bytes([number if usable else 0]) + ",".join(recipe.types).encode()
        self.send(rtde.frame(rtde.SETUP_OUTPUTS, reply))

    def _setup_inputs(self, payload: bytes) -> None:
        number = len(self._inputs) + 1
        recipe = rtde.input_recipe(payload)
        types = [
            rtde.IN_USE if self._owners.get(name, self) is not self else kind
            for name, kind in zip(recipe.names, recipe.types, strict=True)
        ]
        usable = not {rtde.NOT_FOUND, rtde.IN_USE} & set(types)
        if usable:
            self._inputs[number] = recipe
            self._owners |= dict.fromkeys(recipe.names, self)
        reply = bytes([number if usable else 0]) + ",".join(types).encode()
        self.send(rtde.frame(rtde.SETUP_INPUTS, reply))
