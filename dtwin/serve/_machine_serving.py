"""Serving one machine: what ends it, what it waits for, and how a lost link comes back."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable
from typing import Protocol

from dtwin.errors import DeviceError, DtwinError, GateRefusal, InputError
from dtwin.links import layout
from dtwin.serve._journal import LINK_LOST, RECONNECTED, Note
from dtwin.serve._program_watch import fault_of
from dtwin.serve.decision import Decision
from dtwin.serve.live_board import LiveBoard
from dtwin.serve.loop import Link, Mode, ServeStatus, ServingLoop
from dtwin.serve.safety import STALE_WINDOW

RATE_HZ = 500.0
_FIRST_STATE_S = 5.0
# Of faults that a new link may end.
_LINK_CODES = ("ur.", "states.", "serial.", "analogue.tripped")
_BACK_OFF_S, _LONGEST_BACK_OFF_S = 0.1, 5.0
_POLL_S = 0.02

Stop = Callable[[], bool]
Withdrawn = Callable[[], str]


class OpenLink(Link, Protocol):
    """A link that was opened for one machine."""

    @property
    def newest(self) -> layout.RobotState:
        """State (N,) that was returned last."""

    @property
    def realtime(self) -> bool:
        """Whether its own process was given real-time priority."""

    def begin(self) -> None:
        """Take corrections from now on."""

    def close(self) -> None:
        """Release the correction and everything else."""


_Connect = Callable[[], OpenLink]


@dataclasses.dataclass(frozen=True)
class ServingRequest:
    """How to serve a machine.

    ``mode``, one of "live", "shadow", "dry-run": as in ``ServingLoop``.
    ``duration_s``: time to serve; infinite until stopped.
    ``patience_s``: how long to wait for a lost link to come back, and for a protective stop to be unlocked; 0 ends the
    serving at once.
    ``priority``: real-time priority, 0 for none.
    ``echoed``: as in ``ServingLoop``.
    """

    where: str
    mode: Mode = "live"
    duration_s: float = math.inf
    patience_s: float = 0.0
    priority: int = 60
    rate_hz: float = RATE_HZ
    echoed: bool = True


class MachineServing:
    """One machine, over as many links as it takes.

    A lost link is looked for again with a back-off that doubles from 0.1 s to 5 s. A link that
    comes back is admitted anew, and the correction begins at zero under its slew limit. A
    protective stop may be unlocked within the patience; after an emergency stop serving ends.

    ``decision``: features, equation, direction and safety.
    ``connect``: opens a link, or raises: ``DeviceError`` when nobody answers, ``GateRefusal`` when what answers may not
    be served.
    ``withdrawn``: asked every tick; a text says why the model may not be served any more.
    ``reconnects``: links that came back.
    ``realtime``: whether the newest driver was given real-time priority.
    """

    def __init__(
        self,
        request: ServingRequest,
        decision: Decision,
        connect: _Connect,
        note: Note,
        withdrawn: Withdrawn = str,
        board: LiveBoard | None = None,
    ) -> None:
        self._withdrawn, self._board = withdrawn, board
        self._request, self._decision, self._connect, self._note = request, decision, connect, note
        self.reconnects, self.realtime = 0, False
        self._link = self._connected()
        self._loop: ServingLoop | None = None

    def close(self) -> None:
        """Close the link."""
        self._link.close()

    def run(self, asked: Stop) -> ServeStatus:
        """Serve until the time is up, ``asked`` says so, or something fails for good.

        ``asked``: whether somebody asked for the end.
        """
        until_s = time.monotonic() + self._request.duration_s
        first = self._first_sequence()
        self._loop = loop = ServingLoop(
            self._decision,
            self._link,
            period_s=1.0 / self._request.rate_hz,
            mode=self._request.mode,
            first_sequence=first,
            note=self._note,
            board=self._board,
            echoed=self._request.echoed,
        )
        while True:
            stops = _Stops(asked, loop, self._decision, self._request, self._withdrawn)
            left_s = until_s - time.monotonic()
            status = loop.run(max(left_s, 0.0), stop=stops, priority=self._request.priority, begin=self._link.begin)
            status = dataclasses.replace(status, reconnects=self.reconnects)
            if status.fault is not None and self._may_return(status.ended):
                self._note(LINK_LOST, why=status.ended, said=status.fault["message"])
                if self._reconnect(asked, until_s):
                    loop.use(self._link, self._first_sequence())
                    continue
                if asked():
                    return dataclasses.replace(status, ended="stopped", fault=None)
            fault = stops.fault(self._request.where)
            if status.fault is None and fault is not None:
                return dataclasses.replace(status, ended=stops.why, fault=fault.as_dict())
            return status

    def _may_return(self, code: str) -> bool:
        return self._request.patience_s > 0.0 and code.startswith(_LINK_CODES)

    def _connected(self) -> OpenLink:
        link = self._connect()
        try:
            if link.wait_state(_FIRST_STATE_S) is None:
                raise DeviceError("the machine sends no states", code="states.silent", where=self._request.where)
        except BaseException:
            link.close()
            raise
        self.realtime = link.realtime
        return link

    def _first_sequence(self) -> int:
        """Return a number that the controller sees as a change: it may have latched any."""
        newest = self._link.newest
        latched = 0 if self._request.mode == "shadow" else int(newest[layout.APPLIED_SEQUENCE])
        return latched % layout.SEQUENCE_LIMIT + 1

    def _reconnect(self, asked: Stop, until_s: float) -> bool:
        """Look for the machine until it answers, the patience is over, or the end is asked for."""
        self._link.close()
        give_up_s = min(time.monotonic() + self._request.patience_s, until_s)
        wait_s, tries = _BACK_OFF_S, 0
        while _waited(wait_s, give_up_s, asked):
            tries += 1
            try:
                self._link = self._connected()
            except (GateRefusal, InputError) as refusal:
                self._note("refused_on_return", why=refusal.code)
                return False
            except DeviceError as error:
                self._note("still_lost", why=error.code, tries=tries)
                wait_s = min(2.0 * wait_s, _LONGEST_BACK_OFF_S)
                continue
            self.reconnects += 1
            self._note(RECONNECTED, tries=tries)
            return True
        return False


def _waited(wait_s: float, give_up_s: float, asked: Stop) -> bool:
    """Wait, and return whether another try is wanted."""
    until_s = time.monotonic() + wait_s
    while time.monotonic() < until_s:
        if asked() or time.monotonic() > give_up_s:
            return False
        time.sleep(_POLL_S)
    return True


class _Stops:
    """Asked every tick whether to end, and afterwards why."""

    def __init__(
        self, asked: Stop, loop: ServingLoop, decision: Decision, request: ServingRequest, withdrawn: Withdrawn
    ) -> None:
        self._asked, self._watch, self._guard = asked, loop.watch, decision.guard
        self._sensors, self._patience_s = decision.sensors, request.patience_s
        self._withdrawn, self._reason = withdrawn, ""
        self._broken: DtwinError | None = None
        self.why = ""

    def __call__(self) -> bool:
        condition = self._watch.condition
        if condition == "emergency_stop" or (
            condition == "protective_stop" and time.monotonic() - self._watch.since_s >= self._patience_s
        ):
            self.why = "safety_stop"
        elif self._guard.latched:
            self.why = "latched"
        elif self._asked():
            self.why = "stopped"
        elif self._guard.reason == STALE_WINDOW and self._sensors_ended():
            self.why = self._broken.code if self._broken is not None else ""
        else:
            self._reason = self._withdrawn()
            self.why = "withdrawn" if self._reason else ""
        return bool(self.why)

    def _sensors_ended(self) -> bool:
        """Return whether windows will never come again: zeros would be sent for ever."""
        if self._sensors is not None:
            self._broken = self._sensors.fault()
        return self._broken is not None and self._sensors is not None and self._sensors.over

    def fault(self, where: str) -> DtwinError | None:
        """Return what a stop that nobody asked for means."""
        if self._broken is not None and self.why == self._broken.code:
            return self._broken
        if self.why == "latched":
            broken = self._sensors.fault() if self._sensors is not None else None
            got = f"{self._guard.trips} faults" + (f"; the sensors: {broken}" if broken else "")
        else:
            got = self._reason or self._watch.condition.replace("_", " ")
        return fault_of(self.why, where, got)
