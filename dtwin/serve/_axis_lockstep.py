"""Serving a control on the machine clock: it waits for the correction of each of its states."""

from __future__ import annotations

import dataclasses
import math
import time

from dtwin.errors import DeviceError
from dtwin.links import layout
from dtwin.links.axis_link import AxisLink
from dtwin.schema import Floats
from dtwin.serve._axis_inputs import AxisInputs
from dtwin.serve._journal import LINK_LOST, Note, Sparing
from dtwin.serve._machine_serving import Stop, Withdrawn
from dtwin.serve._program_watch import ProgramWatch, fault_of
from dtwin.serve.decision import Decision
from dtwin.serve.live_board import LiveBoard
from dtwin.serve.lockstep import serve_lockstep
from dtwin.serve.loop import ServeStatus
from dtwin.serve.safety import NOT_FINITE, OUTSIDE
from dtwin.serve.serve_request import ServeRequest

_ANSWER_S = 5.0
# The board is for eyes: not every tick of a fast control.
_SHOWN_EVERY_S = 0.02
_ASKED_EVERY_S = 0.1


class _LockstepControl:
    """A control at the other end of a link, as the lock-step loop sees it.

    ``link``: open, with its first state received.
    ``longest_s``: machine time after which it is released.
    ``asked``: whether somebody asked for the end.
    ``withdrawn``: a text says why the model may not be served any more.
    ``why``: why it was released; empty while it was not.
    """

    def __init__(
        self,
        link: AxisLink,
        decision: Decision,
        inputs: AxisInputs,
        longest_s: float,
        asked: Stop,
        withdrawn: Withdrawn,
        board: LiveBoard | None,
        note: Note,
    ) -> None:
        self._link, self._decision, self._inputs = link, decision, inputs
        self._asked, self._withdrawn, self._board = asked, withdrawn, board
        self._program, self._note = ProgramWatch(note), Sparing(note)
        self._stamp_s = -math.inf
        self._begun_s = float(link.newest[layout.TIMESTAMP])
        self._until_s = self._begun_s + longest_s
        self._segment = float(link.newest[layout.SEGMENT_ID])
        self._shown_s, self._asked_s, self._window_age_s = -1.0, 0.0, 0.0
        self.why, self.reason = "", ""

    @property
    def done(self) -> bool:
        """Whether the program has ended, or the correction is released and at zero."""
        return self._link.finished or (bool(self.why) and self._decision.guard.at_rest)

    def state(self) -> Floats:
        """Return the newest state (N,)."""
        state = self._link.newest
        segment = float(state[layout.SEGMENT_ID])
        if segment != self._segment:
            self._segment = segment
            self._inputs.forget()
        windows = self._inputs.windows
        # What was not measured yet is no fault: the correction waits for its first window.
        stamp_s = float(state[layout.TIMESTAMP])
        stands = self._program.hold(state, stamp_s)
        # It waits for each correction: what does not come after the state before is none of now.
        old = stamp_s <= self._stamp_s
        if old:
            self._note("clock_jump", step_s=round(stamp_s - self._stamp_s, 3))
        self._stamp_s = max(stamp_s, self._stamp_s)
        self._decision.hold = stands or old or (windows is not None and not windows.ready)
        return state

    def step(self, registers: Floats) -> None:
        """Send a correction and wait for the state after it."""
        self._judge_window()
        offset_um = registers[layout.REGISTER_OFFSET :]
        self._link.send(offset_um, int(registers[layout.REGISTER_SEQUENCE]))
        self._tell(offset_um)
        # A control that stays silent is a fault of the link, which the link raises.
        while self._link.wait_state(_ANSWER_S) is None:
            pass

    def stops(self) -> bool:
        """Tell whether the correction is to be released; ``why`` says why."""
        if self.why:
            return True
        watch, now_s = self._inputs.watch, time.monotonic()
        if self._decision.guard.latched:
            self.why = "latched"
        elif watch is not None and watch.alarm:
            self.why, self.reason = "diverged", watch.alarm
        elif float(self._link.newest[layout.TIMESTAMP]) >= self._until_s:
            self.why = "duration"
        elif now_s - self._asked_s >= _ASKED_EVERY_S:
            self._asked_s = now_s
            self.reason = self._withdrawn()
            self.why = "stopped" if self._asked() else "withdrawn" if self.reason else ""
        return bool(self.why)

    def _tell(self, offset_um: Floats) -> None:
        """Note why the guard acts, and show the tick."""
        state, reason = self._link.newest, self._decision.guard.reason
        stamp_s = float(state[layout.TIMESTAMP])
        trouble = self._decision.trouble if reason == NOT_FINITE else ""
        self._program.reason(reason, stamp_s, trouble)
        if self._board is not None and abs(stamp_s - self._shown_s) >= _SHOWN_EVERY_S:
            times_s = self._link.greeting.period_s, 0.0, self._decision.window_age_s
            counts = self._decision.guard.counts
            self._board.show(state, offset_um, reason, times_s, (0, 0), self._decision.band_um, counts)
            self._shown_s = stamp_s

    def _judge_window(self) -> None:
        decision, watch = self._decision, self._inputs.watch
        age_s, self._window_age_s = self._window_age_s, decision.window_age_s
        if watch is None or decision.hold or decision.window_age_s >= age_s:
            return
        # Its age has fallen: this tick took a new window.
        inside = decision.guard.reason != OUTSIDE
        watch.window(decision.compiled.told, inside=inside)


def serve_machine_clock(
    link: AxisLink,
    decision: Decision,
    inputs: AxisInputs,
    request: ServeRequest,
    note: Note,
    withdrawn: Withdrawn,
    board: LiveBoard | None,
    asked: Stop,
) -> ServeStatus:
    """Serve a control on its own clock until its program ends or the correction is released.

    ``withdrawn``, ``board``, ``asked``: as for :class:`LockstepControl`.
    """
    if link.wait_state(_ANSWER_S) is None:
        raise DeviceError("the control sends no states", code="states.silent", where=request.place)
    control = _LockstepControl(link, decision, inputs, request.longest_s, asked, withdrawn, board, note)
    status = serve_lockstep(decision, control, period_s=link.greeting.period_s, mode=request.mode, stop=control.stops)
    if status.fault is not None:
        note(LINK_LOST, why=status.ended, said=status.fault["message"])
        return status
    last = status.last_sequence % layout.SEQUENCE_LIMIT + 1
    try:
        link.send(decision.guard.out_um * 0.0, last)
    except DeviceError:
        # It has gone: nothing moves there any more.
        note("gone_before_release")
    trips = f"{decision.guard.trips} faults; {decision.trouble or 'nothing is missing now'}"
    fault = fault_of(control.why, request.place, control.reason or trips)
    return dataclasses.replace(
        status,
        ended=control.why or "finished",
        released=True,
        last_sequence=last,
        fault=fault.as_dict() if fault else None,
    )
