"""The serving loop on the wall clock, with a link; :mod:`dtwin.serve.lockstep` is its other clock."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

import numpy as np

from dtwin.errors import DeviceError
from dtwin.links import state as layout
from dtwin.schema import Floats
from dtwin.serve.decision import Decision
from dtwin.serve.journal import Note, no_journal
from dtwin.serve.live_board import LiveBoard
from dtwin.serve.program_watch import ProgramWatch
from dtwin.serve.realtime import realtime
from dtwin.serve.safety import NOT_FINITE
from dtwin.serve.timing import LoopTiming

Mode = Literal["live", "shadow", "dry-run"]
_RELEASE_MARGIN_S = 0.25
# A controller's stamp that goes ahead by this much more than our own clock has jumped.
_CLOCK_JUMP_S = 0.5


class Link(Protocol):
    """What the wall-clock loop needs of a link to a controller."""

    @property
    def received_s(self) -> float:
        """Monotonic time at which the newest state was received."""
        ...

    def wait_state(self, timeout_s: float) -> Floats | None:
        """Return the newest unseen state (N,), or None when none came in time."""
        ...

    def send(self, offset_um: Floats, sequence: int) -> None:
        """Send a correction (3,) in um with its sequence number."""
        ...


@dataclass(frozen=True)
class ServeStatus:
    """How serving went.

    Attributes
    ----------
    clock : {"wall", "machine"}
        Clock that all times are of.
    mode : {"live", "shadow", "dry-run"}
        ``shadow`` computes and sends nothing, ``dry-run`` sends zeros.
    ended : str
        Why it ended: duration, stopped, finished, latched, or the fault's code.
    released : bool
        Whether the last correction that was sent is exactly zero.
    reasons : dict of str to int
        How often each reason of the guard acted.
    timing : dict
        Stage times, periods, ages, late ticks.
    realtime : dict of str to str
        What the system allowed.
    fault : dict or None
        The device error that ended it.
    largest_um : float
        Longest correction that was computed and let through.
    last_sequence : int
        Sequence number of the last correction sent; 0 when none was.
    reconnects : int
        Links that were lost and came back.
    """

    clock: Literal["wall", "machine"]
    mode: Mode
    ended: str
    released: bool
    reasons: dict[str, int]
    timing: dict[str, Any]
    realtime: dict[str, str] = field(default_factory=dict)
    fault: dict[str, str] | None = None
    largest_um: float = 0.0
    last_sequence: int = 0
    reconnects: int = 0

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return dict(self.__dict__)


class ServingLoop:
    """Serves one decision on the wall clock through a link.

    Parameters
    ----------
    decision : Decision
        Features, equation, direction and safety.
    link : Link
        Source and actuator.
    period_s : float
        Nominal period of the controller's states.
    mode : {"live", "shadow", "dry-run"}
        Whether corrections are sent, withheld, or replaced by zeros.
    first_sequence : int
        Sequence number to start from.
    note : callable
        Takes events.
    board : LiveBoard, optional
        Shows every tick to other processes.
    """

    def __init__(
        self, decision: Decision, link: Link, *, period_s: float = 0.002, mode: Mode = "live",
        first_sequence: int = 1, note: Note = no_journal, board: LiveBoard | None = None,
    ) -> None:  # fmt: skip
        self.decision, self.link, self.mode = decision, link, mode
        self._board = board
        self.timing = LoopTiming(period_s)
        self.watch = ProgramWatch(note)
        self._note, self._period_s = note, period_s
        self._first = first_sequence
        self._sequence = first_sequence - 1
        self._sent_zero, self._largest_um = True, 0.0
        self._zero = np.zeros(3)
        self._last_s = self._last_stamp_s = self._seen_s = np.nan
        self._segment = np.nan

    def use(self, link: Link, first_sequence: int) -> None:
        """Go on with another link; the correction begins at zero, the counts go on.

        Parameters
        ----------
        link : Link
            Source and actuator.
        first_sequence : int
            Sequence number to start from.
        """
        self.link = link
        self._first, self._sequence = first_sequence, first_sequence - 1
        self._last_s = self._last_stamp_s = self._seen_s = self._segment = np.nan
        self.decision.reset()
        self.decision.guard.out_um[:] = 0.0

    def run(
        self, duration_s: float, *, stop: Callable[[], bool] | None = None, priority: int = 60,
        core: int | None = None,
    ) -> ServeStatus:  # fmt: skip
        """Serve until the time is up, a stop is asked for, or the device fails.

        Whatever ends it, the correction is led to zero and zero is sent, as long as the link
        still carries anything; the controller's own watchdog covers the rest.

        Parameters
        ----------
        duration_s : float
            Time to serve.
        stop : callable, optional
            Asked every tick; true ends the serving, as after Ctrl-C.
        priority, core : int
            As in ``realtime``.

        Returns
        -------
        ServeStatus
            How it went; a device fault is in it, not raised.
        """
        fault: DeviceError | None = None
        ended = "duration"
        with realtime(priority, core) as allowed:
            try:
                ended = self._serve(time.monotonic() + duration_s, stop)
            except DeviceError as error:
                fault, ended = error, error.code
            finally:
                fault = self._release() or fault
        return ServeStatus(
            clock="wall",
            mode=self.mode,
            ended=ended,
            released=self._sent_zero,
            reasons=self.decision.guard.counted(),
            timing=self.timing.summary(),
            realtime=allowed,
            fault=fault.as_dict() if fault else None,
            largest_um=self._largest_um,
            last_sequence=max(self._sequence, 0),
        )

    def _serve(self, until_s: float, stop: Callable[[], bool] | None) -> str:
        silence_s = self.decision.guard.limits.stale_s
        while time.monotonic() < until_s:
            if stop is not None and stop():
                return "stopped"
            state = self.link.wait_state(silence_s)
            if state is None:
                self.timing.timeouts += 1
                self._without_state(enabled=True)
            else:
                self._tick(state)
        return "duration"

    def _tick(self, state: Floats) -> None:
        start_ns = time.perf_counter_ns()
        now_s = time.monotonic()
        segment = state[layout.SEGMENT_ID]
        if segment < self._segment:
            self.decision.reset()
        self._segment = segment
        interval_s = now_s - self._last_s
        elapsed_s = interval_s if interval_s >= 0 else self._period_s
        step_s = float(state[layout.TIMESTAMP]) - self._last_stamp_s
        silent_s, self._seen_s = now_s - self._seen_s, now_s
        if step_s < 0.0 or step_s > silent_s + _CLOCK_JUMP_S:
            self._note("clock_jump", step_s=round(step_s, 3))
            self.decision.reset()
            self._last_stamp_s = float(state[layout.TIMESTAMP])
            self._without_state(enabled=True)
            return
        self._require_own_numbers(int(state[layout.APPLIED_SEQUENCE]))
        self.decision.hold = self.watch.hold(state, now_s)
        row = self.timing.stages()
        safe = self.decision.decide(
            state, age_s=now_s - self.link.received_s, elapsed_s=elapsed_s, enabled=True,
            stages=row,
        )  # fmt: skip
        reason = self.decision.guard.reason
        trouble = self.decision.trouble if reason == NOT_FINITE else ""
        self.watch.reason(reason, now_s, trouble)
        before_ns = time.perf_counter_ns()
        sent_um = self._send(safe)
        done_ns = time.perf_counter_ns()
        row[4], row[5] = done_ns - before_ns, done_ns - start_ns
        stamp_s = float(state[layout.TIMESTAMP])
        self.timing.applied(int(state[layout.APPLIED_SEQUENCE]), stamp_s)
        age_s, window_age_s = time.monotonic() - self.link.received_s, self.decision.window_age_s
        self.timing.tick(
            interval_s, step_s, age_s, window_age_s, stamp_s=stamp_s,
            sequence=0 if self.mode == "shadow" else self._sequence,
        )  # fmt: skip
        if self._board is not None:
            self._board.show(
                state, sent_um, self.decision.guard.reason, (interval_s, age_s, window_age_s),
                (self.timing.late, self.timing.missed),
            )  # fmt: skip
        self._last_s, self._last_stamp_s = now_s, stamp_s

    def _without_state(self, *, enabled: bool) -> None:
        now_s = time.monotonic()
        elapsed_s = now_s - self._last_s
        age_s = now_s - self.link.received_s
        self._send(self.decision.release(
            elapsed_s=elapsed_s if elapsed_s >= 0 else self._period_s, age_s=age_s,
            enabled=enabled,
        ))  # fmt: skip
        self.watch.reason(self.decision.guard.reason, now_s)
        self._last_s = now_s

    def _require_own_numbers(self, echoed: int) -> None:
        """Raise when the controller acts on a number that nobody here has sent.

        Raises
        ------
        DeviceError
            Then somebody else writes the correction's registers.
        """
        if self.mode == "shadow" or echoed == 0:
            return
        limit = layout.SEQUENCE_LIMIT
        behind = (self._sequence - echoed) % limit
        # One before the first: what the controller held when we came.
        if behind > (self._sequence - self._first + 1) % limit:
            raise DeviceError(
                "another client writes the correction's registers; ours was released",
                code="serve.other_writer",
                got=f"the controller acts on number {echoed}",
                allowed=f"{self._first} to {self._sequence}",
                hint="end the other program or fieldbus that writes these registers",
            )

    def _send(self, safe_um: Floats) -> Floats:
        """Send what the mode allows of a correction, and return it."""
        length = float(np.sqrt(safe_um @ safe_um))
        if length > self._largest_um:
            self._largest_um = length
        if self.mode == "shadow":
            return self._zero
        offset_um = safe_um if self.mode == "live" else self._zero
        self._sequence = self._sequence % layout.SEQUENCE_LIMIT + 1
        self._sent_zero = False
        self.link.send(offset_um, self._sequence)
        self._sent_zero = not offset_um.any()
        return offset_um

    def _release(self) -> DeviceError | None:
        """Lead the correction to zero and send zero; return what prevented it."""
        limits = self.decision.guard.limits
        patience_s = limits.clamp_um / limits.slew_um_s + _RELEASE_MARGIN_S
        until_s = time.monotonic() + patience_s
        try:
            while not self.decision.guard.at_rest and time.monotonic() < until_s:
                self.link.wait_state(self._period_s)
                self._without_state(enabled=False)
            self.decision.guard.out_um[:] = 0.0
            self._send(self._zero)
        except DeviceError as error:
            self.decision.guard.out_um[:] = 0.0
            return error
        return None
