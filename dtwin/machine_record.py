"""What is known of a machine besides its tests: axes, controller, tolerances, and what happened to it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from datetime import date, timedelta
from pathlib import Path
from typing import Any

from dtwin.atomic import make_folder, read_toml, write_toml
from dtwin.config import Home
from dtwin.errors import NEWER, InputError
from dtwin.kinds.registry import kinds
from dtwin.local_time import local_day, local_time
from dtwin.locks import locked
from dtwin.schema import require_name
from dtwin.tolerances import Limits, limits_from
from dtwin.units import is_number

FACTS = ("type", "serial", "chain", "controller", "instruments", "notes")
EVENTS = ("repair", "crash", "moved", "compensated", "other")
_LENGTHS, _LIMITS = ("travel_mm", "pitch_mm"), ("low_mm", "high_mm")
_AXIS = (*_LENGTHS, *_LIMITS)
_LONGEST = 2000
_MAX_BYTES = 1_000_000
_MOST_DAYS = 3653
_FIELDS = (*FACTS, "test_every_days", "axes", "tolerances", "events")


@dataclass(frozen=True)
class Event:
    """Something that happened to a machine, on a day; ``what`` is one of ``EVENTS``."""

    on: date
    what: str
    note: str = ""

    def as_dict(self) -> dict[str, str]:
        """Return what the file holds; the day is ISO 8601 text."""
        return {"on": self.on.isoformat(), "what": self.what, "note": self.note}


@dataclass(frozen=True)
class MachineRecord:
    """What a user stated of a machine.

    ``facts``: some of ``FACTS``.
    ``axes``: ``travel_mm``, ``pitch_mm`` (0 with a linear scale) and the limits ``low_mm`` and ``high_mm`` of an axis, where they are known.
    ``tolerances``: by the symbol of a test sheet, such as ``G(b)`` or ``A``.
    ``events``: in the order of their days.
    ``test_every_days``: longest time between two tests; 0 when none is stated.
    """

    name: str
    facts: Mapping[str, str] = field(default_factory=dict)
    axes: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    tolerances: Mapping[str, Limits] = field(default_factory=dict)
    events: tuple[Event, ...] = ()
    test_every_days: float = 0.0

    @property
    def reach(self) -> dict[str, dict[str, float]]:
        """The axes as plans need them: limits tell the travel."""
        return {axis: _with_travel(known) for axis, known in self.axes.items()}

    def as_dict(self) -> dict[str, Any]:
        """Return what the file holds; days are ISO 8601 text."""
        return {
            **self.facts,
            **({"test_every_days": self.test_every_days} if self.test_every_days else {}),
            "axes": {axis: dict(known) for axis, known in self.axes.items()},
            "tolerances": {symbol: limits.stated(symbol) for symbol, limits in self.tolerances.items()},
            "events": [event.as_dict() for event in self.events],
        }


def read_record(home: Home, machine: str) -> MachineRecord | None:
    """Return the record of a machine, None when there is none.

    Raises ``InputError`` when the name is not usable, or the file is not a record.
    """
    path = record_file(home, machine)
    try:
        stated = read_toml(path, _MAX_BYTES)
    except FileNotFoundError:
        return None
    except (OSError, ValueError, RecursionError) as error:
        raise _refused(str(path), str(error)[:120], "a TOML file") from error
    return _record_from(machine, stated, str(path))


def _record_from(machine: str, stated: Mapping[str, Any], where: str) -> MachineRecord:
    """Check what is stated of a machine, and return its record.

    Raises ``InputError`` when a field is unknown or not usable.
    """
    unknown = sorted(set(stated) - set(_FIELDS))
    if unknown:
        raise _refused(where, ", ".join(unknown)[:120], ", ".join(_FIELDS), NEWER)
    facts = {name: _text(stated[name], f"{where}: {name}") for name in FACTS if stated.get(name)}
    axes = {axis: _axis(known, f"{where}: axes.{axis}") for axis, known in _table(stated, "axes", where).items()}
    tolerances = limits_from(_table(stated, "tolerances", where), f"{where}: tolerances")
    strange = [symbol for symbol in tolerances if not _is_figure(symbol)]
    if strange:
        of_kind = "; ".join(f"{kind.name}: {', '.join(kind.figures)}" for kind in kinds() if kind.figures)
        allowed = f"SYMBOL, or KIND:SYMBOL where kinds share one. {of_kind}"
        raise _refused(f"{where}: tolerances", ", ".join(strange)[:60], allowed)
    events = stated.get("events", [])
    if not isinstance(events, list):
        raise _refused(f"{where}: events", str(events)[:60], "a list of tables")
    made = [_event(event, f"{where}: events") for event in events]
    every = stated.get("test_every_days", 0.0)
    if not is_number(every) or not 0 <= every <= _MOST_DAYS:
        raise _refused(f"{where}: test_every_days", str(every)[:60], f"days, up to {_MOST_DAYS}")
    return MachineRecord(machine, facts, axes, tolerances, tuple(sorted(made, key=lambda e: e.on)), float(every))


def record_with(home: Home, machine: str, stated: Mapping[str, Any]) -> MachineRecord:
    """Return the record of a machine with what is stated anew; axes and tolerances are joined.

    An axis or a tolerance that is stated as None is taken back.

    Raises ``InputError`` when a field is unknown or not usable, or what is taken back was never stated.
    """
    for symbol, limit in stated.get("tolerances", {}).items():
        if is_number(limit) and limit <= 0 and "Fmin" not in symbol:
            raise _refused(f"{machine}: tolerances", f"{symbol}={limit:g}", "a largest value above 0 µm, or LOW:HIGH")
    document = (read_record(home, machine) or MachineRecord(machine)).as_dict()
    for key, value in stated.items():
        if not isinstance(value, Mapping):
            document[key] = value
            continue
        taken_back = {name for name, told in value.items() if told is None}
        if strange := sorted(taken_back - set(document[key])):
            raise _refused(
                f"{machine}: {key}", f"{strange[0]} taken back", ", ".join(document[key]) or "none is stated"
            )
        document[key] = {n: told for n, told in {**document[key], **value}.items() if n not in taken_back}
    return _record_from(machine, document, machine)


def keep_record(home: Home, machine: str, stated: Mapping[str, Any]) -> MachineRecord:
    """Write the record of a machine with what is stated anew, as ``record_with`` returns it."""
    with _alone(home, machine):
        return _written(home, record_with(home, machine, stated))


def with_event(home: Home, machine: str, what: str, on: str, note: str) -> MachineRecord:
    """Add an event to a record, which is made when there is none; an empty day is today, where this computer stands.

    Raises ``InputError`` when it is not usable, or did not happen yet.
    """
    day = local_day()
    event = _event({"on": on or day.isoformat(), "what": what, "note": note}, "the event")
    if event.on > day + timedelta(days=1):
        raise _refused("the event: on", event.on.isoformat(), f"a day until {day}: a record says what happened")
    with _alone(home, machine):
        known = read_record(home, machine) or MachineRecord(machine)
        return _written(home, replace(known, events=tuple(sorted([*known.events, event], key=lambda e: e.on))))


def without_event(home: Home, machine: str, what: str, on: str, note: str) -> MachineRecord:
    """Take an event back; an empty day is today, and an empty note fits any that is the only one.

    Raises ``InputError`` when no such event is noted, or several that differ.
    """
    wanted = _event({"on": on or local_day().isoformat(), "what": what, "note": note}, "the event")
    with _alone(home, machine):
        known = read_record(home, machine) or MachineRecord(machine)
        of_day = [e for e in known.events if (e.on, e.what) == (wanted.on, wanted.what)]
        same = [e for e in of_day if e.note.strip() == note.strip()]
        meant = same or ([] if note.strip() else of_day)
        if len(set(meant)) != 1:
            noted = [f"{e.on.isoformat()} {e.what} {e.note[:40]}".strip() for e in meant or known.events]
            raise InputError(
                "several such events are noted" if meant else "no such event is noted",
                code="machine.event",
                where=f"machine {machine}",
                got=f"{wanted.on.isoformat()} {what} {note[:40]}".strip(),
                allowed="; ".join(noted[-10:]) or "none is noted",
                hint="name it with --on, and --note where several are of one day",
            )
        events = list(known.events)
        events.remove(meant[0])
        return _written(home, replace(known, events=tuple(events)))


def drop_record(home: Home, machine: str) -> None:
    """Delete what is stated of a machine."""
    with _alone(home, machine):
        record_file(home, machine).unlink(missing_ok=True)


def _alone(home: Home, machine: str) -> AbstractContextManager[bool]:
    """Wait for others that state something of a machine, so that what they state is kept."""
    return locked(home.root / "locks" / f"record-{record_file(home, machine).stem}.lock", wait=True)


def _written(home: Home, record: MachineRecord) -> MachineRecord:
    path = record_file(home, record.name)
    make_folder(path.parent)
    write_toml(path, record.as_dict(), "the record of a machine")
    return record


def tolerances_of(home: Home, machine: str) -> Mapping[str, Limits]:
    """Return the limits that the record of a machine states, by symbol."""
    known = read_record(home, machine)
    return {} if known is None else known.tolerances


def events_of(home: Home, machine: str) -> tuple[Event, ...]:
    """Return what the record of a machine says that happened to it."""
    known = read_record(home, machine)
    return () if known is None else known.events


def events_between(events: Iterable[Event], first: str, last: str) -> list[Event]:
    """Return the events from one day to another, both included; days are ISO 8601, times of day do not count."""
    return [event for event in events if first[:10] <= event.on.isoformat() <= last[:10]]


def changed_since(home: Home, machine: str, moment: str, *, doubtful: bool = False) -> str:
    """Return in words what last changed a machine after a day or time, ISO 8601; empty when nothing did, and notes say nothing of it.

    ``doubtful``: what happened on the very day, too: an event tells no hour, so nobody knows which came first.
    """
    day = local_time(moment)[:10]
    after = [e for e in events_of(home, machine) if e.what != "other" and e.on.isoformat() >= day]
    if not after or (after[-1].on.isoformat() == day and not doubtful):
        return ""
    same = ", the same day" if after[-1].on.isoformat() == day else ""
    return f"{after[-1].what} on {after[-1].on}{same}"


def recorded(home: Home) -> list[str]:
    """Return the machines that have a record."""
    return sorted(path.stem for path in home.machines.glob("*.toml"))


def record_file(home: Home, machine: str) -> Path:
    """Return the file of a machine's record."""
    return home.machines / f"{require_name(machine, 'the machine')}.toml"


def _is_figure(symbol: str) -> bool:
    """Return whether some kind of test, or the one before the colon, tells such a figure, or may."""
    named, _, own = symbol.rpartition(":")
    asked = [kind for kind in kinds() if named in ("", kind.name)]
    return any(own in kind.figures or (not kind.figures and kind.offers("sheet")) for kind in asked)


def _table(stated: Mapping[str, Any], name: str, where: str) -> Mapping[str, Any]:
    value = stated.get(name, {})
    if not isinstance(value, Mapping):
        raise _refused(f"{where}: {name}", str(value)[:60], "a table")
    return value


def _text(value: object, where: str) -> str:
    if not isinstance(value, str) or len(value) > _LONGEST:
        raise _refused(where, str(value)[:60], f"text of at most {_LONGEST} characters")
    return value


def _axis(value: object, where: str) -> dict[str, float]:
    if not isinstance(value, Mapping) or not set(value) <= set(_AXIS):
        raise _refused(where, str(value)[:60], ", ".join(_AXIS))
    for name, number in value.items():
        if not is_number(number) or (name in _LENGTHS and number < 0) or (name == "travel_mm" and number == 0):
            allowed = {"travel_mm": "a positive number", "pitch_mm": "mm per turn; 0 for an axis with a linear scale"}
            raise _refused(f"{where}.{name}", str(number)[:60], allowed.get(name, "a number"))
    known = {name: float(number) for name, number in value.items()}
    if set(_LIMITS) <= set(known) and known["low_mm"] >= known["high_mm"]:
        raise _refused(
            where, f"low_mm {known['low_mm']:g}, high_mm {known['high_mm']:g}", "a low limit below the high one"
        )
    return known


def _with_travel(known: Mapping[str, float]) -> dict[str, float]:
    if not set(_LIMITS) <= set(known):
        return dict(known)
    return {**known, "travel_mm": known["high_mm"] - known["low_mm"]}


def _event(value: object, where: str) -> Event:
    if not isinstance(value, Mapping) or not {"on", "what"} <= set(value) <= {"on", "what", "note"}:
        raise _refused(where, str(value)[:60], "on, what, note")
    if value["what"] not in EVENTS:
        raise _refused(f"{where}: what", str(value["what"])[:60], ", ".join(EVENTS))
    on = value["on"]
    try:
        day = on if type(on) is date else date.fromisoformat(on)
    except (TypeError, ValueError):
        raise _refused(f"{where}: on", str(on)[:60], "a day such as 2026-11-02") from None
    return Event(day, value["what"], _text(value.get("note", ""), f"{where}: note"))


def _refused(where: str, got: str, allowed: str, hint: str | None = None) -> InputError:
    return InputError(
        "the record of a machine is not usable", code="machine.record", where=where, got=got, allowed=allowed, hint=hint
    )
