"""The report of a machine: what changed, its figures over time, its tests, and what is known of it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dtwin.kinds.registry import unit_of_limit
from dtwin.local_time import local_day
from dtwin.pipeline.machine_series import SORTED_BY, TESTS_PER_FALSE_ALARM, by_size
from dtwin.report.history_plots import series_figure
from dtwin.report.html import Section, Table, page
from dtwin.report.language import Language
from dtwin.report.text import series_cells
from dtwin.units import shown_number, shown_unit

_NOTED = "; noted then: "
_BOTH_WAYS = ("D", "B̄")


def machine_report(history: Mapping[str, Any], language: str = "en") -> str:
    """Return the report of a machine as one page that needs nothing else; ``history``: as ``machine_history`` returns it."""
    last = f", the last on {history['last_test']}" if history["last_test"] else ""
    about = f"Tests: {len(history['campaigns'])}{last}; made by dtwin"
    sections = [_changes(history), *_over_time(history), *_by_a_twin(history), _tests(history), *_known(history)]
    words = Language(language, history["campaigns"])
    return page(f"Machine {history['machine']}", about, sections, words)


def overdue(history: Mapping[str, Any]) -> bool:
    """Tell whether the next test was due before today."""
    due = history["next_test"]
    return bool(due) and str(due["on"]) < local_day().isoformat()


def until(known: Mapping[str, Any]) -> str:
    """Return in words of which day the newest test of a twin is, and how many later ones it does not have; ``known``: of a history."""
    day = f"the newest of {known['last_test']}" if known["last_test"] else "of no stated day"
    return f"{day}; later tests that are not in it: {len(known['later'])}" if known["later"] else day


def tolerance_words(symbol: str, limit: Any) -> str:
    """Return a tolerance as people write it: ``≤ 10 µm``."""
    unit = shown_unit(unit_of_limit(symbol))
    if not isinstance(limit, Mapping):
        return f"{'±' if symbol in _BOTH_WAYS else '≤'} {shown_number(limit, 6)} {unit}"
    low, high = (None if limit.get(side) is None else shown_number(limit[side], 6) for side in ("low", "high"))
    if low is None or high is None:
        return f"≤ {high} {unit}" if low is None else f"≥ {low} {unit}"
    return f"{low} to {high} {unit}"


def _changes(history: Mapping[str, Any]) -> Section:
    due, findings = history["next_test"], []
    if overdue(history):
        findings.append(("warning", f"The next test was due on {due['on']}: {due['why']}"))
    changes = by_size(history["series"])
    for change in changes:
        # What somebody noted is told as it was written.
        said, *noted = change["text"].split(_NOTED)
        alarm = "" if change["kind"] == "event" else f"; alarm on {change['seen']}"
        findings.append(("info" if change["kind"] == "event" else "warning", f"{said}{alarm}"))
        findings += [("info", f"noted then: {note}") for note in noted]
    said = [SORTED_BY] if len(changes) > 1 else []
    if not changes:
        told = sum(one["state"] != "too few tests" for one in history["series"])
        said = [
            "Nothing changed, as far as its figures tell" if told else "Whether anything changed cannot be told yet"
        ]
    said.append(
        "An alarm compares a test with those before it; where nothing changes, at most one is expected in "
        f"{TESTS_PER_FALSE_ALARM:g} tests"
    )
    if due and not overdue(history):
        said.append(f"The next test is due on {due['on']}: {due['why']}")
    return Section("What changed", said, findings)


def _over_time(history: Mapping[str, Any]) -> list[Section]:
    if not history["series"]:
        return []
    head = ("figure", "state", "level", "noise floor of tests", "since", "tests", "limit")
    rows = [
        (*cells[:-1], str(len(one["points"])), cells[-1]) for one in history["series"] for cells in [series_cells(one)]
    ]
    said = (
        "± of a level covers 95 % of its mean; within the noise floor another test lies with 95 % while nothing changes"
    )
    figures = [series_figure(one, history["events"]) for one in history["series"]]
    return [Section("Figures over time", [said], [], [Table(head, rows)], figures)]


def _by_a_twin(history: Mapping[str, Any]) -> list[Section]:
    if not (known := history["known"]):
        return []
    rows = [(one["title"], one["size"]) for one in known["effects"]]
    said = [f"By {', '.join(known['campaigns'])}", until(known)]
    return [Section("What its twin knows", said, [], [Table(("effect", "size (k = 2)"), rows)])]


def _tests(history: Mapping[str, Any]) -> Section:
    rows = [
        (
            test["campaign"],
            str(test["started"] or "-")[:10],
            ", ".join(filter(None, (test["figure"], test["condition"]))) or "-",
            f"{test['shown']} {shown_unit(test['unit'])}" if test["shown"] else "-",
            f"a copy of {test['copy_of']}" if test.get("copy_of") else test["decision"] or "-",
        )
        for test in reversed(history["tests"])
    ]
    return Section(
        "Tests",
        ["Of several conditions the largest"],
        [],
        [Table(("test", "day", "figure", "value", "decision"), rows)],
    )


def _known(history: Mapping[str, Any]) -> list[Section]:
    facts = [(name, fact) for name, fact in history["facts"].items()]
    for axis, known in history["axes"].items():
        lengths = ", ".join(f"{name.removesuffix('_mm')} {shown_number(v, 6)} mm" for name, v in known.items())
        facts.append((f"axis {axis}", lengths))
    limits = [(symbol, tolerance_words(symbol, limit)) for symbol, limit in history["tolerances"].items()]
    events = [(event["on"], event["what"], event["note"] or "-") for event in history["events"]]
    tables = [
        *([Table(("fact", "stated"), facts)] if facts else []),
        *([Table(("tolerance", "limit"), limits)] if limits else []),
        *([Table(("day", "event", "note"), events)] if events else []),
    ]
    return [Section("What is known of it", [], [], tables)] if tables else []
