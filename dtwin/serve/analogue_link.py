"""States from a control's feed, corrections to the analogue board: one link for the serving loop."""

from __future__ import annotations

import contextlib
import dataclasses
from pathlib import Path

import numpy as np

from dtwin.errors import DeviceError, InputError
from dtwin.links import layout
from dtwin.links.analogue import TRAVEL_UM, AnalogueOutput, AxisCalibration
from dtwin.links.analogue_calibration import load
from dtwin.links.state_feed import StateFeed
from dtwin.schema import Floats
from dtwin.serve.runtime import CompiledBundle


@dataclasses.dataclass(frozen=True)
class AnalogueWiring:
    """How an analogue correction is connected.

    Attributes:
        states: ``HOST:PORT`` of the control's state feed.
        calibration: What ``dtwin analogue calibrate`` wrote; None only for a run that sends zeros or nothing.
        watchdog_ms: Silence after which the board goes neutral by itself.
        states_hz: How often the feed sends a state.
    """

    port: str
    states: str
    calibration: Path | None = None
    watchdog_ms: int = 100
    states_hz: float = 500.0

    def __post_init__(self) -> None:
        if not 1.0 <= self.states_hz <= 10_000.0:
            raise InputError(
                "the state feed cannot have this rate",
                code="states.rate",
                got=f"{self.states_hz} Hz",
                allowed="1 to 10000 Hz",
            )

    def axes(self, *, moves: bool) -> tuple[AxisCalibration, ...]:
        """Return the calibration of x, y and z.

        Raises ``InputError`` when a correction that moves the machine has none.
        """
        if self.calibration is not None:
            return tuple(load(self.calibration))
        if moves:
            raise InputError(
                "what a volt does to each axis was not measured",
                code="analogue.uncalibrated",
                allowed="--calibration FILE, as dtwin analogue calibrate writes it",
                hint="a wrong sign doubles the error; --dry-run sends zeros without it",
            )
        return (AxisCalibration(),) * 3


class AnalogueLink:
    """What the serving loop needs, over a state feed and a board.

    Args:
        writes: Engage the board; false for a run that only looks.
        moves: Whether corrections other than zero may be sent.

    Raises:
        DeviceError: When feed or board do not answer.
        InputError: When the calibration is missing or unusable.
    """

    realtime = False

    def __init__(self, wiring: AnalogueWiring, *, writes: bool, moves: bool) -> None:
        calibration = wiring.axes(moves=moves)
        self._feed = StateFeed(wiring.states)
        self._output: AnalogueOutput | None = None
        self._feed.open()
        if not writes:
            return
        output = AnalogueOutput(wiring.port, calibration, watchdog_ms=wiring.watchdog_ms)
        try:
            output.open()
        except BaseException:
            self._feed.close()
            raise
        self._output = output

    @property
    def received_s(self) -> float:
        """Monotonic time at which the newest state was received."""
        return self._feed.received_s

    @property
    def newest(self) -> layout.RobotState:
        """State (N,) that was returned last."""
        return self._feed.newest

    def wait_state(self, timeout_s: float) -> Floats | None:
        """Return the newest unseen state (N,), or None; see ``StateFeed``.

        Which correction is in force is the board's to say, and renewed with or without a state.
        """
        state = self._feed.wait_state(timeout_s)
        if self._output is not None:
            self._output.poll()
            self._feed.newest[layout.APPLIED_SEQUENCE] = self._output.in_force
        return state

    def begin(self) -> None:
        """Let the board take corrections from now on; its watchdog begins to count."""
        if self._output is not None:
            self._output.engage()

    def send(self, offset_um: Floats, sequence: int) -> None:
        """Send a correction (3,) with the number that ``applied_sequence`` is once the board has it.

        Raises ``DeviceError`` when the board tripped, refused, is silent, or does not hold what was sent.
        """
        if self._output is not None:
            self._output.send(offset_um, sequence)

    def close(self) -> None:
        """Go neutral when the board still listens, and release port and feed."""
        output, self._output = self._output, None
        self._feed.close()
        if output is not None:
            # A board that does not answer any more goes neutral by its own watchdog.
            with contextlib.suppress(DeviceError):
                output.settle()
            with contextlib.suppress(DeviceError):
                output.release()
            output.close()


def within_travel(compiled: CompiledBundle) -> CompiledBundle:
    """Return the model with its clamp within what the analogue input can reach.

    Args:
        compiled: The model; one that asks for less comes back as it is.
    """
    safety = compiled.bundle.safety
    if safety.clamp_um <= TRAVEL_UM:
        return compiled
    return compiled.limited(dataclasses.replace(safety, clamp_um=TRAVEL_UM))


NO_TOOL_MM: Floats = np.zeros(3)
"""Tool centre point of a machine without joints: no lever is counted from it."""
