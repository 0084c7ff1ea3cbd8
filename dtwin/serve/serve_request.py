"""What a user asks of a serving session, and what came of it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from dtwin.errors import EXIT_DEVICE, EXIT_DONE, EXIT_GATE, EXIT_INTERRUPTED, InputError
from dtwin.serve._machine_serving import RATE_HZ, ServingRequest
from dtwin.serve.analogue_link import AnalogueWiring
from dtwin.serve.loop import Mode, ServeStatus
from dtwin.serve.pointer import Resolved
from dtwin.serve.proved import WhenExpired


@dataclass(frozen=True)
class ServeRequest:
    """What a user asked for.

    Attributes:
        model: ``latest``, ``trial``, or the path of a bundle.
        machine: Machine; None when only one has a model.
        duration_s: Time to serve; None until stopped.
        mode: As in ``ServingLoop``. One of "live", "shadow", "dry-run".
        trial: Serve under the tight clamp of a trial, whatever the model's state.
        priority: Real-time priority, 0 for none.
        patience_s: How long to wait for a lost link to come back, and for a protective stop to be unlocked; 0 ends the
            serving at once.
        analogue: Board and state feed of an analogue correction.
        axes: ``HOST:PORT`` of a control that takes offsets of its axes; without it and without a board, a robot at
            ``host``.
        expired: What to do with a champion whose evidence is older than its bundle allows. One of "refuse", "warn".
        fade: Whether a correction smaller than its own uncertainty fades out; None: where the bundle says how uncertain
            it is.
    """

    model: str = "latest"
    machine: str | None = None
    host: str = "127.0.0.1"
    duration_s: float | None = None
    mode: Mode = "live"
    trial: bool = False
    priority: int = 60
    covariates: Mapping[str, float] = field(default_factory=dict)
    patience_s: float = 0.0
    analogue: AnalogueWiring | None = None
    axes: str | None = None
    expired: WhenExpired = "refuse"
    fade: bool | None = None

    @property
    def place(self) -> str:
        """Where the machine's end is: an address, or a board's port."""
        if self.axes is not None:
            return self.axes
        return self.host if self.analogue is None else self.analogue.port

    @property
    def longest_s(self) -> float:
        """Time to serve; infinite until stopped."""
        return math.inf if self.duration_s is None else self.duration_s

    def serving(self, rate_hz: float | None = None) -> ServingRequest:
        """Return how the machine is to be served.

        Args:
            rate_hz: Of its states, for a control that says so itself.
        """
        end = "control" if self.axes else "robot" if self.analogue is None else "board"
        known_hz = RATE_HZ if self.analogue is None else self.analogue.states_hz
        return ServingRequest(
            f"{end} at {self.place}",
            self.mode,
            self.longest_s,
            self.patience_s,
            self.priority,
            rate_hz or known_hz,
            echoed=self.analogue is None,
        )

    def __post_init__(self) -> None:
        if not 0.0 <= self.patience_s < math.inf:
            raise InputError(
                "the patience is not a time to wait",
                code="serve.patience",
                got=f"{self.patience_s} s",
                allowed="0 s or more",
            )
        if self.duration_s is not None and not 0.0 < self.duration_s < math.inf:
            raise InputError(
                "the duration is not a time to serve",
                code="serve.duration",
                got=f"{self.duration_s} s",
                allowed="more than 0 s; leave it out to serve until Ctrl-C",
            )
        if not 0 <= self.priority <= 99:
            raise InputError(
                "no such priority", code="serve.priority", got=str(self.priority), allowed="0 (none) to 99"
            )


@dataclass(frozen=True)
class Served:
    """What came of a session.

    Attributes:
        clamp_um: Longest correction that was allowed.
        driver_realtime: Whether the driver process was given real-time priority.
        log: Path of the session log, or why there is none.
        band: What the uncertainty of the correction is from; empty when the bundle does not tell it.
        fades: Whether a correction smaller than its uncertainty fades out.
    """

    request: ServeRequest
    resolved: Resolved
    device: str
    trial: bool
    clamp_um: float
    status: ServeStatus
    driver_realtime: bool
    log: str = ""
    band: str = ""
    fades: bool = False

    @property
    def exit_code(self) -> int:
        """4 after a fault, 3 when the model was withdrawn, 130 when stopped before the time that was asked for, else 0."""
        if self.status.ended == "withdrawn":
            return EXIT_GATE
        if self.status.fault is not None:
            return EXIT_DEVICE
        early = self.status.ended == "stopped" and self.request.duration_s is not None
        return EXIT_INTERRUPTED if early else EXIT_DONE

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        resolved = self.resolved
        return {
            "machine": resolved.machine,
            "model": {
                "asked": self.request.model,
                "version": resolved.version,
                "state": resolved.state,
                "bundle": str(resolved.path),
                "sha256": resolved.sha256,
                "model_sha256": resolved.model_sha256,
                "proved": resolved.proved,
            },
            "host": self.request.place,
            "device": self.device,
            "trial": self.trial,
            "clamp_um": self.clamp_um,
            "band": self.band,
            "fades": self.fades,
            "driver_realtime": self.driver_realtime,
            "log": self.log,
            **self.status.as_dict(),
        }
