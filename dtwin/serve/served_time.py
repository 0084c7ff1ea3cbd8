"""When which correction was in force, as the journal of the serving sessions has it."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from dtwin.atomic import append_line
from dtwin.config import Home
from dtwin.errors import InputError, StoreError
from dtwin.schema import MIXED_CORRECTION, require_name
from dtwin.serve._journal import CLOCK_SET, ENDED, KILLED, LINK_LOST, NOT_RELEASED, RECONNECTED, RELEASED, SERVING
from dtwin.serve._lease import is_leased
from dtwin.units import is_number

_ENDS = (RELEASED, NOT_RELEASED, ENDED, KILLED)
_LAST_LINES_S = 0.3
_LONGEST_S = 1e9
_FOREVER = datetime.max.replace(tzinfo=UTC)


@dataclass(frozen=True)
class ServedStretch:
    """A stretch of time in which one model corrected a machine without a break.

    ``begin``, ``end``: from the first correction that could be sent to the release; ``end`` is in the year 9999 while a
    session goes on.
    ``model_sha256``: ``Bundle.model_sha256`` of what was served.
    """

    begin: datetime
    end: datetime
    model_sha256: str
    device: str
    trial: bool


def events_path(home: Home, machine: str) -> Path:
    """Return the file of the events of a machine's sessions."""
    return home.logs / f"serve-{require_name(machine, 'the machine')}.events.jsonl"


def served_stretches(home: Home, machine: str) -> list[ServedStretch]:
    """Return when a machine was corrected live, oldest first.

    A session that looked on or sent zeros corrected nothing. While a link was lost nothing is
    known to have been corrected. A session that a power cut ended, or the end of its container, wrote no last line:
    it is over when its machine is held by nobody, and the journal says so from now on.

    Raises ``StoreError`` when the journal cannot be read.
    """
    _end_what_is_dead(home, machine)
    return _stretches(_journal_of(home, machine))


def served_during(
    stretches: Iterable[ServedStretch], begin: datetime, end: datetime, where: str
) -> ServedStretch | None:
    """Return what was in force throughout a time, None when nothing was at any moment of it.

    ``stretches``: from :func:`served_stretches`.
    ``where``: what it is the time of, for error messages.
    Raises ``InputError`` when the correction began or ended within it.
    """
    touched = [s for s in stretches if s.begin < end and begin < s.end]
    if not touched:
        return None
    first = touched[0]
    if len(touched) == 1 and first.begin <= begin and end <= first.end:
        return first
    raise InputError(
        "a correction was in force during a part of the run only",
        code="served.partly",
        where=where,
        got=", ".join(_told(s) for s in touched[:4]),
        allowed=f"one correction or none from {begin.isoformat()} to {end.isoformat()}",
        hint="measure it again; start dtwin serve before the recording and end it afterwards",
    )


def correction_in_force(home: Home, machine: str) -> Callable[[datetime, datetime], str]:
    """Return a function that tells which model corrected a machine between two times.

    It returns the model's checksum, nothing when there was no correction, and ``mixed`` when one
    was in force during a part of the time only.

    ``home``, ``machine``: as for :func:`served_stretches`.
    """
    # What is dead now corrects none of the runs to come; asked after them, it would seem to have died then.
    _end_what_is_dead(home, machine)

    def between(begin: datetime, end: datetime) -> str:
        try:
            in_force = served_during(served_stretches(home, machine), begin, end, machine)
        except InputError:
            return MIXED_CORRECTION
        return in_force.model_sha256 if in_force else ""

    return between


def serving_now(home: Home, machine: str) -> str:
    """Return the checksum of the model that corrects a machine at this moment, empty without."""
    return next((s.model_sha256 for s in served_stretches(home, machine) if s.end == _FOREVER), "")


def never_released(home: Home, machine: str) -> tuple[list[datetime], datetime | None]:
    """Return when sessions of a machine began to correct that were killed, or of which nothing says how they ended.

    Returns those before the newest session, oldest first; and the newest session if it is one, else None.
    """
    begun: dict[str, datetime] = {}
    newest = ""
    for event in _journal_of(home, machine):
        if _begins(event):
            newest = event["session"]
            begun[newest] = event["at"]
        elif event.get("event") in (RELEASED, NOT_RELEASED, ENDED):
            begun.pop(event["session"], None)
    last = begun.pop(newest, None)
    return list(begun.values()), last


def _end_what_is_dead(home: Home, machine: str) -> None:
    # A session that ends lets go of its machine first, and its last lines follow.
    for wait_s in (_LAST_LINES_S, 0.0):
        session = _not_ended(home, machine)
        if not session or is_leased(machine, home):
            return
        time.sleep(wait_s)
    line = {"time": datetime.now(UTC).isoformat(timespec="milliseconds"), "event": KILLED, "session": session}
    append_line(events_path(home, machine), json.dumps(line | {"found": "nobody holds the machine"}).encode())


def _not_ended(home: Home, machine: str) -> str:
    """Return the newest session that began to correct, when no line says that it ended."""
    left = ""
    for event in _journal_of(home, machine):
        if _begins(event):
            left = event["session"]
        elif event["session"] == left and event.get("event") in _ENDS:
            left = ""
    return left


def _number(value: object) -> float:
    return float(value) if is_number(value) and abs(value) < _LONGEST_S else 0.0


def _told(stretch: ServedStretch) -> str:
    until = "now" if stretch.end == _FOREVER else stretch.end.isoformat(timespec="seconds")
    return f"{stretch.begin.isoformat(timespec='seconds')} to {until}"


def _journal_of(home: Home, machine: str) -> Iterable[Mapping[str, Any]]:
    """Return the events of a machine's sessions in the order in which they were written, each with its time as ``at``."""
    path = events_path(home, machine)
    try:
        lines = path.read_bytes().splitlines() if path.exists() else []
    except OSError as error:
        raise StoreError(
            "the journal of the serving sessions cannot be read",
            code="served.journal",
            where=str(path),
            got=error.strerror or str(error),
        ) from error
    return _events(lines)


def _events(lines: Iterable[bytes]) -> Iterable[Mapping[str, Any]]:
    for line in lines:
        try:
            document = json.loads(line)
            at = datetime.fromisoformat(document["time"])
            if at.tzinfo is None:
                raise ValueError("a time without its zone")
            yield document | {"at": at, "session": str(document.get("session"))}
        except (ValueError, KeyError, TypeError, RecursionError):
            # The end of a line that a full disk cut off.
            continue


def _begins(event: Mapping[str, Any]) -> bool:
    """Tell whether a session begins to correct with an event."""
    return event.get("event") == SERVING and event.get("mode") == "live"


def _stretches(events: Iterable[Mapping[str, Any]]) -> list[ServedStretch]:
    done: list[ServedStretch] = []
    going: dict[str, ServedStretch] = {}
    lost: dict[str, ServedStretch] = {}
    latest: dict[str, datetime] = {}

    def ended(session: str, at: datetime) -> ServedStretch:
        stretch = going.pop(session)
        return replace(stretch, begin=min(stretch.begin, at), end=max(stretch.begin, at, latest.get(session, at)))

    for event in events:
        session, what = event["session"], event.get("event")
        if _begins(event):
            # One session at a time holds the lease: another that never ended is dead.
            done += [ended(left, event["at"]) for left in list(going)]
            going[session] = ServedStretch(
                event["at"],
                _FOREVER,
                str(event.get("model_sha256", "")),
                str(event.get("device", "real")),
                bool(event.get("trial", False)),
            )
        elif what == CLOCK_SET and session in going:
            # By the clock it was in force until then, and from then: all between counts.
            before = event["at"] - timedelta(seconds=_number(event.get("by_s")))
            latest[session] = max(before, latest.get(session, before))
            going[session] = replace(going[session], begin=min(going[session].begin, event["at"]))
        elif what == LINK_LOST and session in going:
            lost[session] = ended(session, event["at"])
            done.append(lost[session])
        elif what == RECONNECTED and session in lost:
            going[session] = replace(lost.pop(session), begin=event["at"], end=_FOREVER)
        elif what in _ENDS:
            lost.pop(session, None)
            if session in going:
                done.append(ended(session, event["at"]))
    return sorted([*done, *going.values()], key=lambda s: s.begin)
