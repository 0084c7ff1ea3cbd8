"""What the tests of a machine say together, in sentences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from dtwin.machine_record import Event, events_between
from dtwin.physics.effect import Effect
from dtwin.report._recorded import contradiction_words, events_words
from dtwin.report.faults import title_of, with_k2
from dtwin.report.text import words_of

_Told = Mapping[str, Any]
# Share of their difference by which two sizes may fail to be opposite.
_OPPOSITE = 0.1


def joint_lines(joint: Mapping[str, Any], library: Mapping[str, Effect], events: Sequence[Event] = ()) -> list[str]:
    """Return contradictions first, then what was settled, then what agrees.

    ``joint``: as ``Joint.as_dict`` gives it.
    ``events``: what is recorded of the machine.
    """
    apart = [s for s in joint["shared"] if s["apart"]]
    agreed = [s for s in joint["shared"] if not s["apart"]]
    return [
        *(_contradiction(s, events) for s in apart),
        *(
            _settled(s, library, {test["campaign"]: test["started"] for test in joint.get("tests", ())}, events)
            for s in joint["settled"]
        ),
        *(_agreement(s) for s in agreed),
    ]


def _size(size: _Told, unit: str) -> str:
    return f"{size['campaign']} {with_k2(size['value'], size['uncertainty'], unit)}"


def _cause(shared: _Told) -> str:
    return f"{words_of(shared['cause'])} {shared['axis']}".rstrip()


def _agreement(shared: _Told) -> str:
    sizes = "; ".join(_size(size, shared["unit"]) for size in shared["sizes"])
    together = with_k2(shared["value"], shared["uncertainty"], shared["unit"])
    if len(shared["sizes"]) == 1:
        (size,) = shared["sizes"]
        return f"{_cause(shared)}: {together}, as {words_of(size['label'])} ({size['campaign']})."
    return f"{_cause(shared)}: {together} from {len(shared['sizes'])} tests that agree ({sizes})."


def _contradiction(shared: _Told, events: Sequence[Event]) -> str:
    sizes = "; ".join(f"{_size(size, shared['unit'])} ({size['started'][:10] or 'no day'})" for size in shared["sizes"])
    first, second, by, spread = max(shared["apart"], key=lambda a: abs(a[2]) / a[3])
    days = sorted(size["started"] for size in shared["sizes"] if size["campaign"] in (first, second))
    between = tuple(days) if len(days) == 2 and days[0] else ()
    told = [[e.as_dict() for e in events_between(events, *between)]] if between else []
    value = {size["campaign"]: size["value"] for size in shared["sizes"]}
    one, other = value[first], value[second]
    opposite = (
        " Equal and opposite: directions, or signs, may be exchanged in one of the files."
        if abs(one + other) < _OPPOSITE * abs(one - other)
        else ""
    )
    return (
        f"{_cause(shared)} contradicts itself: {sizes}. Between {first} and {second} lie "
        f"{with_k2(by, spread, shared['unit'])}: {contradiction_words('change or mistake', between, told)}.{opposite}"
    )


def _settled(settled: _Told, library: Mapping[str, Effect], started: Mapping[str, str], events: Sequence[Event]) -> str:
    names = [_within(label, library) for label in settled["group"]]
    left = [_within(label, library) for label in settled["left"]]
    reasons = [
        f"{_within(j['label'], library)} {_WORDS[j['said']]}: {_size(j['there'], unit)}, as the cause it would be "
        f"{with_k2(j['here']['value'], j['here']['uncertainty'], unit)}"
        for j in settled["judged"]
        for unit in [_unit(j["label"], library)]
    ]
    end = "it is " + left[0] if len(left) == 1 else " or ".join(left) + " remain" if left else "all are ruled out"
    differ = [j["there"]["started"] for j in settled["judged"] if j["said"] != "agrees"]
    days = sorted([started.get(settled["campaign"], ""), *differ])
    meanwhile = (
        events_words([e.as_dict() for e in events_between(events, days[0], days[-1])]) if differ and days[0] else ""
    )
    changed = f" Or the machine changed: {meanwhile} lies between these tests." if meanwhile else ""
    return f"{settled['campaign']} could not tell {names[0]} from {' or '.join(names[1:])}: {end} ({'; '.join(reasons)}).{changed}"


_WORDS = {"agrees": "agrees", "is a part": "is a part of it", "refuted": "is ruled out"}


def _within(label: str, library: Mapping[str, Effect]) -> str:
    """Return the name as it stands within a sentence."""
    title = title_of(label, library)
    return title[:1].lower() + title[1:]


def _unit(label: str, library: Mapping[str, Effect]) -> str:
    return library[label.partition(" ")[0]].parameters[0].unit
