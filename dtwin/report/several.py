"""Tests and twins of several campaigns of a machine, as text and as sections of a report, and what the record of the machine says of contradictions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from dtwin.machine_record import Event, events_between
from dtwin.physics.effect import Effect
from dtwin.physics.several_twin import SeveralTwin
from dtwin.report import twins
from dtwin.report.faults import title_of, with_k2
from dtwin.report.html import Section, Table
from dtwin.report.text import micrometres, table, words_of
from dtwin.report.twins import history_section as history_section
from dtwin.report.twins import number

if TYPE_CHECKING:
    from dtwin.twins.several import SeveralComparison

_HEAD = ("campaign", "kind", "begun", "left, µm RMS", "of it repeats agree on, µm", "noise floor, µm")


def twin_text(twin: SeveralTwin) -> str:
    """Return a twin for the terminal."""
    shown = campaign_table(twin.as_dict())
    return "\n".join([twins.twin_text(twin), table(shown.head, shown.rows), *contradiction_lines(twin.as_dict())])


def comparison_text(result: Mapping[str, Any]) -> str:
    """Return a comparison for the terminal, campaign by campaign."""
    return "\n\n".join([*(twins.comparison_text(one) for one in result["campaigns"]), *contradiction_lines(result)])


def diagnosis_text(name: str, result: Mapping[str, Any]) -> str:
    """Return a diagnosis for the terminal: of all together, and what each campaign says by itself."""
    shown = _said_table(result)
    lines = [*contradiction_lines(result), *_explanation_lines(result), *_settled_lines(result)]
    return "\n".join([twins.diagnosis_text(name, result), table(shown.head, shown.rows), *lines])


def diagnosis_section(name: str, result: Mapping[str, Any]) -> Section:
    """Return what is missing."""
    made = twins.diagnosis_section(name, result)
    told = [("warning", line) for line in contradiction_lines(result)]
    told += [("info", line) for line in (*_explanation_lines(result), *_settled_lines(result))]
    return Section(made.title, made.paragraphs, [*made.findings, *told], [_said_table(result)], made.figures, made.code)


def twin_section(twin: SeveralTwin) -> Section:
    """Return the twin and its parameters."""
    made = twins.twin_section(twin)
    told = [("warning", line) for line in contradiction_lines(twin.as_dict())]
    return Section(made.title, made.paragraphs, [*made.findings, *told], [*made.tables, campaign_table(twin.as_dict())])


def comparison_sections(comparison: SeveralComparison, result: Mapping[str, Any]) -> list[Section]:
    """Return measured against predicted, campaign by campaign."""
    return [
        replace(made, title=f"{made.title}: {one['campaign']}")
        for part, one in zip(comparison.parts, result["campaigns"], strict=True)
        for made in twins.comparison_sections(part, one)
    ]


def campaign_table(document: Mapping[str, Any]) -> Table:
    """Return what the twin leaves of each campaign."""
    rows = [
        (
            one["campaign"],
            one["kind"],
            one["started"][:10] or "-",
            micrometres(one["residual_rms_um"]),
            number(one["systematic_rms_um"]),
            number(one["noise_floor_um"]),
        )
        for one in document["campaigns"]
    ]
    return Table(_HEAD, rows)


def _said_table(result: Mapping[str, Any]) -> Table:
    rows = [
        (
            one["campaign"],
            one["kind"],
            one["started"][:10] or "-",
            one["verdict"],
            "; ".join(" or ".join(group) for group in one["found"]) or "-",
            number(one["noise_floor_um"]),
        )
        for one in result["campaigns"]
    ]
    return Table(("campaign", "kind", "begun", "by itself", "found by itself", "noise floor, µm"), rows)


def contradiction_lines(document: Mapping[str, Any]) -> list[str]:
    """Return what campaigns do not agree on: by how much, since when, what was recorded then, and what that may be."""
    out = []
    for one in document.get("contradictions", ()):
        size = with_k2(one["difference"], one["k2"], one["unit"])
        since = f" since {one['since'][:10]}" if one["since"] else ""
        where = f"{one['effect']} {one['axis']}".rstrip()
        rivals = (
            f", or {' or '.join(one['rivals'])}, which these tests cannot tell from it" if one.get("rivals") else ""
        )
        out.append(
            f"contradiction{since}: {where} ({one['parameter'].replace('_', ' ')}) of {', '.join(one['campaigns'])} is "
            f"{size} beside that of {', '.join(one['others'])} (p = {one['p_value']:.1g}){rivals}: "
            + contradiction_words(one["what"], one.get("between", ()), one.get("events", ()))
        )
    return out


def _explanation_lines(result: Mapping[str, Any]) -> list[str]:
    """Return which effects would make a contradiction vanish."""
    return [f"{name} would explain what campaigns say of {what}" for name, what in result["explained"].items()]


def _settled_lines(result: Mapping[str, Any]) -> list[str]:
    """Return which groups one campaign leaves open and another settles."""
    words = {"agrees": "agrees with", "is a part": "is a part of it by", "refuted": "is ruled out by"}
    out = []
    for one in result["settled"]:
        judged = "; ".join(f"{j['label']} {words[j['said']]} {j['there']['campaign']}" for j in one["judged"])
        left = " or ".join(one["left"]) or "none of them"
        out.append(f"settled: {one['campaign']} could not tell {', '.join(one['group'])}; it is {left} ({judged})")
    # Of a diagnosis that was kept by a version before.
    if other := result.get("ruled_out"):
        out.append(f"ruled out, for tests at other conditions would need other sizes: {', '.join(other)}")
    return out


_Events = Sequence[Mapping[str, str]]
_UNDATED = {
    "change": "the machine changed then",
    "mistake": "tests before and after agree with each other, so that this one is mistaken",
    "change or mistake": "the machine changed, or one of them is mistaken",
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
    return ", ".join(f"{_what(e)} of {e['on']}" + (f" ({e['note']})" if e["note"] else "") for e in events)


def _what(event: Mapping[str, str]) -> str:
    return {"moved": "move", "compensated": "compensation", "other": "event"}.get(event["what"], event["what"])


_Told = Mapping[str, Any]


def joint_lines(found: Mapping[str, Any], library: Mapping[str, Effect], events: Sequence[Event] = ()) -> list[str]:
    """Return contradictions first, then what was settled, then what agrees.

    ``found``: as ``Joint.as_dict`` gives it.
    ``events``: what is recorded of the machine.
    """
    apart = [s for s in found["shared"] if s["apart"]]
    agreed = [s for s in found["shared"] if not s["apart"]]
    return [
        *(_contradiction(s, events) for s in apart),
        *(_settled(s, library) for s in found["settled"]),
        *(_agreement(s) for s in agreed),
    ]


def _size(size: _Told, unit: str) -> str:
    return f"{size['campaign']} {with_k2(size['value'], size['uncertainty'], unit)}"


def _cause(shared: _Told) -> str:
    return f"{words_of(shared['cause'])} {shared['axis']}".rstrip()


def _agreement(shared: _Told) -> str:
    sizes = "; ".join(_size(size, shared["unit"]) for size in shared["sizes"])
    together = with_k2(shared["value"], shared["uncertainty"], shared["unit"])
    return f"{_cause(shared)}: {together} from {len(shared['sizes'])} tests that agree ({sizes})."


def _contradiction(shared: _Told, events: Sequence[Event]) -> str:
    sizes = "; ".join(f"{_size(size, shared['unit'])} ({size['started'][:10] or 'no day'})" for size in shared["sizes"])
    first, second, by, spread = max(shared["apart"], key=lambda a: abs(a[2]) / a[3])
    days = sorted(size["started"] for size in shared["sizes"] if size["campaign"] in (first, second))
    between = tuple(days) if len(days) == 2 and days[0] else ()
    told = [[e.as_dict() for e in events_between(events, *between)]] if between else []
    return (
        f"{_cause(shared)} contradicts itself: {sizes}. Between {first} and {second} lie "
        f"{with_k2(by, spread, shared['unit'])}: {contradiction_words('change or mistake', between, told)}."
    )


def _settled(settled: _Told, library: Mapping[str, Effect]) -> str:
    names = [_within(label, library) for label in settled["group"]]
    left = [_within(label, library) for label in settled["left"]]
    reasons = [
        f"{_within(j['label'], library)} {_WORDS[j['said']]}: {_size(j['there'], unit)}, as the cause it would be "
        f"{with_k2(j['here']['value'], j['here']['uncertainty'], unit)}"
        for j in settled["judged"]
        for unit in [_unit(j["label"], library)]
    ]
    end = "it is " + left[0] if len(left) == 1 else " or ".join(left) + " remain" if left else "all are ruled out"
    return (
        f"{settled['campaign']} could not tell {names[0]} from {' or '.join(names[1:])}: {end} ({'; '.join(reasons)})."
    )


_WORDS = {"agrees": "agrees", "is a part": "is a part of it", "refuted": "is ruled out"}


def _within(label: str, library: Mapping[str, Effect]) -> str:
    """Return the name as it stands within a sentence."""
    title = title_of(label, library)
    return title[:1].lower() + title[1:]


def _unit(label: str, library: Mapping[str, Effect]) -> str:
    return library[label.partition(" ")[0]].parameters[0].unit
