"""What the record of a machine says of tests that contradict each other, in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

_Events = Sequence[Mapping[str, str]]
_UNDATED = {
    "change": "the machine changed then",
    "mistake": "tests before and after agree with each other, so that this one is mistaken",
    "change or mistake": "the machine changed, or one of them is mistaken",
}


_NAMED = {
    "repair": "repair of",
    "crash": "crash of",
    "moved": "move of",
    "compensated": "compensation of",
    "other": "event of",
}


def contradiction_words(what: str, between: Sequence[str] = (), events: Sequence[_Events] = ()) -> str:
    """Return what a contradiction may be.

    ``what``: ``change``, ``mistake`` or ``change or mistake``, as the tests alone tell it.
    ``between``: days of the tests around it, ISO 8601; empty where they are not known.
    ``events``: what was recorded from each of these days to the next: ``on``, ``what`` and ``note``.
    """
    if not between:
        return _UNDATED[what]
    days = [day[:10] for day in between]
    if what != "mistake":
        if events[0]:
            return f"since the {events_words(events[0])}, which is recorded between these tests"
        nothing = f"nothing is recorded between {days[0]} and {days[1]}"
        if what == "change":
            return f"{nothing}: a change that was not recorded, for later tests agree with it"
        return f"{nothing}: a mistake of measuring, or a change that was not recorded"
    before, after = (events[0], events[1]) if len(events) > 1 else (events[0], ())
    if before and after:
        return (
            f"tests before and after agree with each other, and the {events_words(before)} and the {events_words(after)} are "
            "recorded before and after it: a change that was undone, or a mistake of measuring"
        )
    if before or after:
        said = f"though the {events_words(before or after)} is recorded {'before' if before else 'after'} it"
        return f"{_UNDATED[what]}, {said}"
    return f"{_UNDATED[what]}; nothing is recorded between {days[0]} and {days[-1]}"


def events_words(events: _Events) -> str:
    """Return events with their days and notes, in a line; empty without any."""
    return ", ".join(f"{_what(e)} {e['on']}" + (f" ({e['note']})" if e["note"] else "") for e in events)


def _what(event: Mapping[str, str]) -> str:
    return _NAMED.get(event["what"], f"{event['what']} of")
