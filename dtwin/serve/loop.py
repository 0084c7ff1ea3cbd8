"""The serving loop on the wall clock, with a link; :mod:`dtwin.serve.lockstep` is its other clock."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

import numpy as np

from dtwin.errors import DeviceError
from dtwin.links import layout
from dtwin.schema import Floats
from dtwin.serve._in_force import InForce
from dtwin.serve._journal import Note, Sparing, no_journal
from dtwin.serve._program_watch import ProgramWatch
from dtwin.serve._timing import LoopTiming, StampWatch
from dtwin.serve.decision import Decision
from dtwin.serve.live_board import LiveBoard
from dtwin.serve.realtime import realtime
from dtwin.serve.safety import ENGAGING, IMPOSSIBLE, JUMPED, NOT_FINITE, OK, STALLED

Mode = Literal["live", "shadow", "dry-run"]
# A busy host takes longer for its steps; what silence holds up, the machine's watchdog releases.
_RELEASE_PATIENCE, _RELEASE_MARGIN_S = 5.0, 0.25


class Link(Protocol):
    """What the wall-clock loop needs of a link to a controller."""

    @property
    def received_s(self) -> float:
        """Monotonic time at which the newest state was received."""

    def wait_state(self, timeout_s: float) -> Floats | None:
        """Return the newest unseen state (N,), or None when none came in time.

        ``applied_sequence`` is the number of the correction that the machine's end has in force, 0 when it
        has none: before the first, and when its watchdog has let go. What it let go of comes back only
        from zero. The array is valid until the next call, which may renew it though it returns None.
        """

    def send(self, offset_um: Floats, sequence: int) -> None:
        """Send a correction (3,) in um with its sequence number."""


@dataclass(frozen=True)
class ServeStatus:
    """How serving went.

    Attributes:
        clock: Clock that all times are of. One of "wall", "machine".
        mode: ``shadow`` computes and sends nothing, ``dry-run`` sends zeros. One of "live", "shadow", "dry-run".
        ended: Why it ended: duration, stopped, finished, latched, or the fault's code.
        released: Whether the last correction that was sent is exactly zero.
        reasons: How often each reason of the guard acted.
        largest_um: Longest correction that was computed and let through.
        largest_band_um: Largest uncertainty (k = 2) of a correction that the model asked for; 0 where it does not tell.
        last_sequence: Sequence number of the last correction sent; 0 when none was.
        reconnects: Links that were lost and came back.
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
    largest_band_um: float = 0.0
    last_sequence: int = 0
    reconnects: int = 0

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return dict(self.__dict__)


class ServingLoop:
    """Serves one decision on the wall clock through a link.

    Args:
        decision: Features, equation, direction and safety.
        period_s: Nominal period of the controller's states.
        mode: Whether corrections are sent, withheld, or replaced by zeros. One of "live", "shadow", "dry-run".
        first_sequence: Sequence number to start from.
        echoed: Whether states come from what takes the corrections, so that a number just sent proves a state new;
            without, states that lag behind their stamps stay old.
    """

    def __init__(
        self,
        decision: Decision,
        link: Link,
        *,
        period_s: float = 0.002,
        mode: Mode = "live",
        first_sequence: int = 1,
        note: Note = no_journal,
        board: LiveBoard | None = None,
        echoed: bool = True,
    ) -> None:
        self.decision, self.link, self.mode = decision, link, mode
        self._board = board
        self.timing = LoopTiming(period_s)
        self.watch = ProgramWatch(note)
        self._note, self._period_s, self._echoed = Sparing(note), period_s, echoed
        self._sent_zero, self._largest_um = True, 0.0
        self._zero = np.zeros(3)
        self._begin(first_sequence)

    def _begin(self, first_sequence: int) -> None:
        self._in_force, self._stamps = InForce(first_sequence), StampWatch()
        self._newest, self._leading_back = layout.empty_state(), False
        self._last_s = self._last_stamp_s = self._heard_s = self._segment = np.nan

    def use(self, link: Link, first_sequence: int) -> None:
        """Go on with another link; the correction begins at zero, the counts go on.

        Args:
            first_sequence: Sequence number to start from.
        """
        self.link = link
        self._begin(first_sequence)
        self.decision.reset()
        self.decision.guard.out_um[:] = 0.0

    def run(
        self,
        duration_s: float,
        *,
        stop: Callable[[], bool] | None = None,
        priority: int = 60,
        core: int | None = None,
        begin: Callable[[], None] | None = None,
    ) -> ServeStatus:
        """Serve until the time is up, a stop is asked for, or the device fails.

        Whatever ends it, the correction is led to zero and zero is sent, as long as the link
        still carries anything; the controller's own watchdog covers the rest.

        Args:
            stop: Asked every tick; true ends the serving, as after Ctrl-C.
            priority: As in ``realtime``.
            core: As in ``realtime``.
            begin: Called when all is prepared, which takes longer than a watchdog waits.

        Returns:
            How it went; a device fault is in it, not raised.
        """
        fault: DeviceError | None = None
        ended = "duration"
        with realtime(priority, core) as allowed:
            try:
                if begin is not None:
                    begin()
                ended = self._serve(time.monotonic() + duration_s, stop)
            except DeviceError as error:
                fault, ended = error, error.code
            finally:
                fault = self._release() or fault
                self._note.end()
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
            largest_band_um=self.decision.direction.largest_band_um,
            last_sequence=max(self._in_force.sequence, 0),
        )

    def _serve(self, until_s: float, stop: Callable[[], bool] | None) -> str:
        silence_s = self.decision.guard.limits.stale_s
        while time.monotonic() < until_s:
            if stop is not None and stop():
                return "stopped"
            state = self.link.wait_state(self._period_s if self._leading_back else silence_s)
            if state is None:
                self.timing.timeouts += 1
                self._without_state(enabled=True)
            else:
                self._tick(state)
        return "duration"

    def _tick(self, state: Floats) -> None:
        start_ns = time.perf_counter_ns()
        now_s = time.monotonic()
        self._newest, self._leading_back = state, False
        stamp_s = float(state[layout.TIMESTAMP])
        engaged = self._heed()
        # What was sent long ago and is not in force: the state is old, or nothing arrives there.
        overdue = self._in_force.overdue_s(now_s) > self.decision.guard.limits.stale_s
        if overdue or self._stamps.repeats(stamp_s):
            self._without_state(enabled=True)
            return
        segment = state[layout.SEGMENT_ID]
        if segment < self._segment:
            self.decision.reset()
        self._segment = segment
        interval_s, step_s = now_s - self._last_s, stamp_s - self._last_stamp_s
        fault = self._found(stamp_s, interval_s, engaged=engaged)
        if self._stamps.jump_s:
            # The clock was set: no state was missed for that.
            step_s = interval_s
        self._heard_s = self.link.received_s
        self.decision.hold = self.watch.hold(state, now_s)
        row = self.timing.stages()
        safe = self.decision.decide(
            state,
            age_s=now_s - self._heard_s,
            elapsed_s=self._room_um() / self.decision.guard.limits.slew_um_s,
            enabled=True,
            stages=row,
            found=fault,
        )
        reason = self.decision.guard.reason
        trouble = self.decision.trouble if reason in (NOT_FINITE, IMPOSSIBLE) else ""
        self.watch.reason(reason, now_s, trouble)
        before_ns = time.perf_counter_ns()
        # What was decided before the loop was held up is as old as that.
        late = time.monotonic() - now_s > self.decision.guard.limits.stale_s
        sent_um = self._zero if late else self._send(safe)
        done_ns = time.perf_counter_ns()
        row[4], row[5] = done_ns - before_ns, done_ns - start_ns
        self.timing.applied(self._number_in_force() or 0, stamp_s)
        age_s, window_age_s = time.monotonic() - self.link.received_s, self.decision.window_age_s
        self.timing.tick(
            interval_s,
            step_s,
            age_s,
            window_age_s,
            stamp_s=stamp_s,
            sequence=0 if self.mode == "shadow" else self._in_force.sequence,
        )
        if self._board is not None:
            self._board.show(
                state,
                sent_um,
                self.decision.guard.reason,
                (interval_s, age_s, window_age_s),
                (self.timing.late, self.timing.missed),
                self.decision.band_um,
            )
        self._last_s, self._last_stamp_s = now_s, stamp_s

    def _found(self, stamp_s: float, interval_s: float, *, engaged: bool) -> int:
        """Return what is wrong with the time of a state, or with what the machine's end holds."""
        limits = self.decision.guard.limits
        fresh = self._echoed or self.mode == "shadow"
        steady = self._stamps.steady(stamp_s, self.link.received_s, fresh=fresh)
        if self._stamps.jump_s:
            self._note("clock_jump", step_s=round(self._stamps.jump_s, 3))
            self.decision.reset()
        # For so long it may have waited for a state, and no longer.
        if interval_s > limits.stale_s + self._period_s:
            self._note("stalled", gap_s=round(interval_s, 4))
            return STALLED
        if not steady:
            return JUMPED
        return OK if engaged else ENGAGING

    def _heed(self) -> bool:
        """Take what the machine's end reports as in force; tell whether it may leave zero."""
        if self.mode == "shadow":
            return True
        number = self._number_in_force()
        # What it let go of it takes again only from zero, so that ours may go there in steps: if it only says
        # that it let go, nothing jumps.
        if number is not None and self._in_force.report(number):
            self._note("let_go", after=self._in_force.sequence)
        return self._in_force.engaged

    def _number_in_force(self) -> int | None:
        number = float(self._newest[layout.APPLIED_SEQUENCE])
        return int(number) if 0.0 <= number <= layout.SEQUENCE_LIMIT else None

    def _room_um(self) -> float:
        """Return how far the next correction may go: one step, less what is not in force yet."""
        slew_um_s = self.decision.guard.limits.slew_um_s
        if self.mode != "live":
            return slew_um_s * self._period_s
        # Two states that come at once are no reason for two steps at once.
        step_um = slew_um_s * min(self._in_force.since_s(time.monotonic()), self._period_s)
        return self._in_force.room_um(self.decision.guard.out_um, step_um)

    def _without_state(self, *, enabled: bool) -> None:
        """Go on towards zero while no state comes, as long as it is known what is in force.

        Where nothing says so any more nothing is sent: then the machine's own watchdog leads to zero.
        """
        now_s = time.monotonic()
        engaged, room_um = self._heed(), self._room_um()
        # Its watchdog never drops a zero: if what was sent after it got lost, nothing else would come.
        again = engaged and room_um == 0.0 and self._in_force.rests
        if again:
            self.decision.guard.out_um[:] = 0.0
        safe = self.decision.release(
            elapsed_s=room_um / self.decision.guard.limits.slew_um_s,
            age_s=max(now_s - self._heard_s, self._in_force.overdue_s(now_s)),
            enabled=enabled,
            found=OK if engaged else ENGAGING,
        )
        if room_um > 0.0 or again:
            self._send(safe)
        self._leading_back = room_um > 0.0 and not self.decision.guard.at_rest
        self.watch.reason(self.decision.guard.reason, now_s)
        self._last_s = now_s

    def _send(self, safe_um: Floats) -> Floats:
        """Send what the mode allows of a correction, and return it."""
        length = float(np.sqrt(safe_um @ safe_um))
        if length > self._largest_um:
            self._largest_um = length
        if self.mode == "shadow":
            return self._zero
        offset_um = safe_um if self.mode == "live" else self._zero
        self._sent_zero = False
        self.link.send(offset_um, self._in_force.sent(offset_um, time.monotonic()))
        self._sent_zero = not offset_um.any()
        return offset_um

    def _release(self) -> DeviceError | None:
        """Lead the correction to zero and send zero; return what prevented it."""
        limits = self.decision.guard.limits
        patience_s = _RELEASE_PATIENCE * limits.clamp_um / limits.slew_um_s + _RELEASE_MARGIN_S
        until_s = time.monotonic() + patience_s
        with contextlib.suppress(DeviceError):
            while not self.decision.guard.at_rest and time.monotonic() < until_s:
                state = self.link.wait_state(self._period_s)
                self._newest = self._newest if state is None else state
                self._without_state(enabled=False)
        try:
            # Whatever is reported, as by somebody else's number, or no more at all: in steps from what was sent.
            while self.mode == "live" and not self.decision.guard.at_rest:
                time.sleep(self._period_s)
                self._send(self.decision.release(elapsed_s=self._period_s))
            self._send(self._zero)
        except DeviceError as error:
            return error
        return None
