"""A virtual control in a thread of its own, for tests that serve it."""

from __future__ import annotations

import threading
from types import TracebackType
from typing import Generic, Self, TypeVar

from dtwin.config import Home
from dtwin.links.virtual_key import proof
from dtwin.machines.axis_server import AxisMachine, AxisServer, Clock

M = TypeVar("M", bound=AxisMachine)


class AxisControl(Generic[M]):
    """Runs a machine's program once, corrected by who connects to ``address``.

    Args:
        machine: What is moved.
        home: Whose key proves that it is virtual.
        clock: As for ``AxisServer``. One of "wall", "machine".
    """

    def __init__(self, machine: M, home: Home, clock: Clock = "machine") -> None:
        self.machine = machine
        self.server = AxisServer(machine, lambda nonce: proof(home, nonce), clock=clock)
        self.address = f"127.0.0.1:{self.server.port}"
        self.error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self.join()
        self.server.close()

    def join(self) -> None:
        """Wait until the program has ended."""
        self._thread.join(120.0)
        assert not self._thread.is_alive(), "the program has not ended"
        assert self.error is None, self.error

    def _run(self) -> None:
        try:
            self.server.run(lambda line: None, lambda done, total, what: None)
        except BaseException as error:
            self.error = error
