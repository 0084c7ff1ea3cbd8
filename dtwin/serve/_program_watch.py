"""What the robot's program is doing, and when a correction may come back after it stopped; what an unasked end of serving means."""

from __future__ import annotations

import math

from dtwin.errors import DeviceError, DtwinError, GateRefusal
from dtwin.links import layout
from dtwin.schema import Floats
from dtwin.serve._journal import Bucket, Note, no_journal
from dtwin.serve.safety import REASONS

_SETTLE_S = 1.0
"""How long a robot must have run again, after a stop, before it is corrected again."""

_NOTE_EVERY_S = 0.05
_ABOUT = {"not_finite": "sensors", "impossible_state": "state"}
_HARMLESS = ("ok", "shrunk", "clamped", "slew_limited")


def _condition_of(state: Floats) -> str:
    """Return what a state says of the program: the strongest of its reasons to stand still.

    ``state`` (N,): state of the controller.
    Returns ``running``, ``paused``, ``stopped``, ``protective_stop`` or ``emergency_stop``.
    """
    safety, running = state[layout.SAFETY_OK], state[layout.RUNTIME_RUNNING]
    if safety != layout.SAFE:
        return "protective_stop" if safety == layout.PROTECTIVE_STOP else "emergency_stop"
    if running == layout.RUNNING:
        return "running"
    return "paused" if running == layout.PAUSED else "stopped"


class ProgramWatch:
    """Holds the correction back while the program stands, and notes why.

    ``condition``: as :func:`_condition_of`.
    """

    def __init__(self, note: Note = no_journal) -> None:
        self.condition = ""
        self.since_s = math.nan
        self._note = note
        self._free_at_s = -math.inf
        self._reason, self._noted_s = "", -math.inf
        self._bucket = Bucket()

    def hold(self, state: Floats, now_s: float) -> bool:
        """Tell whether the correction is to be held at zero for this state."""
        condition = _condition_of(state)
        if condition != self.condition:
            self._change(condition, now_s)
        return condition != "running" or now_s < self._free_at_s

    def reason(self, number: int, now_s: float, trouble: str = "") -> None:
        """Note why the guard acts when that has changed; what changes again and again is noted sparingly.

        ``number``: position in ``REASONS``.
        ``now_s``: monotonic time.
        ``trouble``: which sensor is in trouble, or which number of the state, for a guard that acts on it.
        """
        name = REASONS[number]
        name = "correcting" if name in _HARMLESS else name
        due = name != self._reason and now_s - self._noted_s > _NOTE_EVERY_S
        if due and self._bucket.take(now_s):
            self._reason, self._noted_s = name, now_s
            about = {_ABOUT[name]: trouble} if trouble and name in _ABOUT else {}
            self._note("guard", why=name, **about)

    def _change(self, condition: str, now_s: float) -> None:
        before, self.condition, self.since_s = self.condition, condition, now_s
        if before.endswith("_stop") or before == "stopped":
            self._free_at_s = now_s + _SETTLE_S
        if before or condition != "running":
            self._note("program", was=before or "unknown", now=condition)


_DEVICE = {
    "safety_stop": (
        "the machine stopped for safety; the correction was released",
        "clear the stop at the machine, find its cause, then serve again",
    ),
    "latched": (
        "too many faults; the correction was released and stays so",
        "the Live page of dtwin ui says which, and so does the session's log below DTWIN_HOME/logs; serve again to arm it",
    ),
    "diverged": (
        "the correction did not settle; it was released",
        "dtwin models shows what the gates said of this version",
    ),
}


def fault_of(why: str, where: str, got: str) -> DtwinError | None:
    """Return the fault behind an end, None when it is none.

    ``why``: ``safety_stop``, ``latched``, ``diverged``, ``withdrawn``, or anything else.
    """
    if why == "withdrawn":
        return GateRefusal(
            "the model was withdrawn while it was served; the correction was released",
            code="serve.withdrawn",
            where=where,
            got=got,
            hint="dtwin models shows the history; serve again for the champion of now",
        )
    if why in _DEVICE:
        message, hint = _DEVICE[why]
        return DeviceError(message, code=f"serve.{why}", where=where, got=got, hint=hint)
    return None
