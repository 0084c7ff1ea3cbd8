"""Figures of a machine from test to test: series, what changed in them, and when the next test is due."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date, datetime, timedelta
from itertools import pairwise
from typing import Any

import numpy as np

from dtwin.control_chart import Chart, Regime, chart, crossing
from dtwin.documents import finite
from dtwin.machine_record import Event, MachineRecord, events_between
from dtwin.report.text import decimals
from dtwin.schema import Floats
from dtwin.units import shown_unit

TESTS_PER_FALSE_ALARM = 200.0
"""Tests of a machine where nothing changes, all its series together, in which one false alarm is expected at most."""
_RESTARTS = ("repair", "compensated", "moved")
"""Events after which another value is expected."""
ALARMS = ("changed", "trend", "slow trend")
"""States of a series that are no rest, the most urgent first."""
_WORST = ("outside", "cannot say", "inside", "")
_MONTH = 30.44
_LONGEST_FORECAST_DAYS = 3653.0


@dataclass(frozen=True)
class Point:
    """A figure in one test.

    ``started``: ISO 8601.
    ``expanded``: half width that covers 95 %; NaN when it is not known.
    ``instrument``: what measured it; empty when it is not stated.
    """

    campaign: str
    started: str
    value: float
    expanded: float
    instrument: str = ""


@dataclass(frozen=True)
class Series:
    """A figure over the tests of a machine, in the order of their days.

    ``title``: condition, or effect and axis.
    ``figure``: symbol of a standard, or the parameter of the effect.
    ``low``, ``high``: tolerance.
    """

    title: str
    figure: str
    unit: str
    points: tuple[Point, ...]
    low: float | None = None
    high: float | None = None

    @property
    def name(self) -> str:
        """Figure and condition in a line."""
        return f"{self.figure}, {self.title}" if self.figure else self.title


def judged_series(series: Sequence[Series], record: MachineRecord, among: int = 0) -> list[dict[str, Any]]:
    """Return every series with its chart, what changed, and how it goes on, JSON-ready; those that changed come first.

    The rate of false alarms is that of all series together; ``among``: how many they are, where these are some of them.
    """
    length = TESTS_PER_FALSE_ALARM * max(among, len(series), 1)
    told = [_judged(one, record, length) for one in series]
    order = {"changed": 0, "trend": 1, "slow trend": 2, "steady": 3, "too few tests": 4}
    return sorted(told, key=lambda one: (order[one["state"]], -len(one["points"])))


SORTED_BY = (
    "The largest change first: by a tenth of a tolerance or more, then of figures without one by how many times "
    "their noise floor, then by less of a tolerance"
)
_MATTERS = 0.1


def by_size(series: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Return the changes of all series as ``SORTED_BY`` says; ``series``: as ``judged_series`` returns them."""

    def size(change: Mapping[str, Any]) -> tuple[int, float]:
        share = change["of_tolerance"]
        return (1, change["of_floor"] or 0.0) if share is None else (2 if share >= _MATTERS else 0, share)

    return sorted((change for one in series for change in one["changes"]), key=size, reverse=True)


def worst_newest(tests: Sequence[Mapping[str, Any]]) -> Mapping[str, Any] | None:
    """Return the test with the worst decision among those whose planes or axes no later one of their kind has measured.

    ``tests``: of a machine's history, in order of time. Of equal decisions the newest; None without a figure.
    """
    newest: list[Mapping[str, Any]] = []
    for test in reversed([one for one in tests if one["figure"]]):
        if not any(test["kind"] == one["kind"] and {*test["moved"]} <= {*one["moved"]} for one in newest):
            newest.append(test)
    return min(newest, key=lambda test: _WORST.index(test["decision"]), default=None)


def next_test(series: Sequence[Mapping[str, Any]], record: MachineRecord, last: str) -> dict[str, str]:
    """Return the day of the next test and why it is that day; empty when nothing says so.

    ``series``: as ``judged_series`` returns them.
    ``last``: day of the last test, ISO 8601; empty when there is none.
    """
    dates: list[tuple[date, str]] = []
    if last and record.test_every_days:
        due = date.fromisoformat(last[:10]) + timedelta(days=record.test_every_days)
        dates.append((due, f"a test is wanted every {record.test_every_days:g} days"))
    for one in series:
        crossing = one["crossing"]
        if crossing is not None:
            dates.append((date.fromisoformat(crossing["earliest"]), f"{one['name']} may cross its limit from then on"))
    if not dates:
        return {}
    on, why = min(dates)
    return {"on": on.isoformat(), "why": why}


def calendar_of(machine: str, due: Mapping[str, str], now: datetime) -> str:
    """Return the next test as a calendar file (iCalendar, RFC 5545)."""
    day = due["on"].replace("-", "")
    # A title of somebody's own effect may have lines.
    why = " ".join(due["why"].split()).replace("\\", "\\\\").replace(",", "\\,").replace(";", "\\;")
    lines = [
        "BEGIN:VCALENDAR",
        "VERSION:2.0",
        "PRODID:-//dtwin//machine//EN",
        "BEGIN:VEVENT",
        f"UID:{machine}-{day}@dtwin",
        f"DTSTAMP:{now:%Y%m%dT%H%M%SZ}",
        f"DTSTART;VALUE=DATE:{day}",
        f"SUMMARY:Test of {machine}",
        f"DESCRIPTION:{why}",
        "END:VEVENT",
        "END:VCALENDAR",
    ]
    return "".join(f"{line}\r\n" for line in _folded(lines))


def _folded(lines: Sequence[str]) -> list[str]:
    """Return lines of at most 75 octets, as the standard asks for."""
    out: list[str] = []
    for line in lines:
        part = ""
        for letter in line:
            if len((part + letter).encode()) > 74:
                out.append(part)
                part = " "
            part += letter
        out.append(part)
    return out


def _judged(series: Series, record: MachineRecord, run_length: float) -> dict[str, Any]:
    points = series.points
    days = np.array([datetime.fromisoformat(p.started).timestamp() / 86400.0 for p in points])
    values = np.array([p.value for p in points])
    why = _restarts(points, record.events)
    charted = chart(days, values, list(why), run_length)
    current = charted.regimes[-1]
    limit = _limit_ahead(series, current)
    part = slice(current.first, None)
    ahead = None if limit is None else crossing(days[part], values[part], limit)
    changes = _changes(series, charted, why, record.events)
    last = charted.alarms[-1] if charted.alarms and charted.alarms[-1].first >= current.first else None
    # What later tests left of an alarm may be no more than its own uncertainty.
    changed = last is not None and (last.trend or _sure(last.step, last.expanded))
    if len(points) < 4:
        state = "too few tests"
    elif current.trend:
        state = "trend"
    else:
        # A line that leads to a limit is none of the chart's alarms yet, and no level either.
        state = "changed" if changed else "slow trend" if ahead is not None else "steady"
    mean, half = _level(current, days)
    level = f"{mean:z.{decimals(half)}f}"
    return finite(
        {
            "name": series.name,
            "title": series.title,
            "figure": series.figure,
            "unit": shown_unit(series.unit),
            "low": series.low,
            "high": series.high,
            "points": [dict(vars(p)) for p in points],
            "state": state,
            "level": f"{level} ± {half:z.{decimals(half)}f}" if current.last > current.first else level,
            "floor": f"± {current.floor:z.{decimals(current.floor)}f}" if math.isfinite(current.floor) else "",
            "since": points[current.first].started[:10],
            "changes": changes,
            "crossing": _told_crossing(ahead, limit, days),
            "chart": {
                "ewma": charted.ewma.tolist(),
                "cusum_up": charted.cusum_up.tolist(),
                "cusum_down": charted.cusum_down.tolist(),
                "single": charted.single.tolist(),
                "limits": dict(vars(charted.limits)),
                "regimes": [dict(vars(r)) for r in charted.regimes],
                "alarms": [a.at for a in charted.alarms],
            },
        }
    )


def _restarts(points: Sequence[Point], events: Sequence[Event]) -> dict[int, str]:
    """Return the tests before which another value is expected, and why; an event on the day of a test came before it."""
    reasons: dict[int, str] = {}
    for i, (before, after) in enumerate(pairwise(points), start=1):
        between = [
            e for e in events if e.what in _RESTARTS and before.started[:10] < e.on.isoformat() <= after.started[:10]
        ]
        if between:
            reasons[i] = ", ".join(e.note or e.what for e in between)
        elif before.instrument != after.instrument and before.instrument and after.instrument:
            reasons[i] = f"measured with {after.instrument} instead of {before.instrument}: machine or instrument"
    return reasons


def _level(regime: Regime, days: Floats) -> tuple[float, float]:
    """Return the level of tests, of a trend that of its line at the last one, and its half width that covers 95 %."""
    if not regime.trend:
        return regime.mean, regime.expanded
    mine = days[regime.first : regime.last + 1]
    of_mean = regime.floor / math.sqrt(len(mine) + 1)
    return regime.ends[1], math.hypot(of_mean, regime.slope_expanded * float(mine[-1] - mine.mean()))


_LITTLE = 0.5
"""Of what a trend makes in all: a smaller step where it begins is no change of its own."""


def _changes(series: Series, chart: Chart, why: Mapping[int, str], events: Sequence[Event]) -> list[dict[str, Any]]:
    """Return every change: alarms, and what differs after an event, JSON-ready, newest first.

    ``of_tolerance``, ``of_floor``: its size as a share of the tolerance, and of the noise floor of the tests around it.
    """
    points, out = series.points, []
    unit = shown_unit(series.unit)
    # Where a level goes over into a trend the chart gives two alarms, of one change.
    rises = {r.first: abs(r.ends[1] - r.ends[0]) for r in chart.regimes if r.trend}
    turns = {a.first: a.at for a in chart.alarms if not a.trend and abs(a.step) < _LITTLE * rises.get(a.first, 0.0)}
    for alarm in chart.alarms:
        regime = next(r for r in chart.regimes if r.first == alarm.first)
        if not alarm.trend and alarm.first in turns:
            continue
        at = turns.get(alarm.first, alarm.at)
        if alarm.trend:
            change = regime.ends[1] - regime.ends[0]
            size = _signed(regime.slope * _MONTH, regime.slope_expanded * _MONTH)
            began, ended = (points[i].started[:10] for i in (regime.first, regime.last))
            over = f"since {began}" if regime.last == len(points) - 1 else f"from {began} to {ended}"
            text = f"{series.name} changes by {size} {unit} a month {over}"
        else:
            began, change = points[alarm.first - 1].started[:10], alarm.step
            size = f"{_signed(alarm.step, alarm.expanded)} {unit}"
            between = f"between {began} and {points[alarm.first].started[:10]}"
            if _sure(alarm.step, alarm.expanded):
                text = f"{series.name} changed by {size} {between}"
            else:
                text = f"{series.name} may have changed {between}: the chart gave an alarm, and by all tests it is {size}, which may be nothing"
            noted = events_between(events, began, points[alarm.first].started)
            text += "".join(f"; noted then: {e.what}{e.note and ', '}{e.note}" for e in noted)
        out.append(
            {
                "kind": "trend" if alarm.trend else "step",
                "at": at,
                "first": alarm.first,
                "text": text,
                "began": began,
                "seen": points[at].started[:10],
                **_shares(series, chart, alarm.first, change),
            }
        )
    for i, reason in why.items():
        before = next(r for r in chart.regimes if r.last == i - 1)
        after = next(r for r in chart.regimes if r.first == i)
        half = math.hypot(before.expanded, after.expanded)
        change = after.mean - before.mean
        text = f"{series.name} {_signed(change, half)} {unit} after: {reason}"
        out.append(
            {
                "kind": "event",
                "at": i,
                "first": i,
                "text": text,
                "began": points[i - 1].started[:10],
                "seen": points[i].started[:10],
                **_shares(series, chart, i, change),
            }
        )
    return sorted(out, key=lambda change: -int(str(change["at"])))


def _shares(series: Series, chart: Chart, first: int, change: float) -> dict[str, float | None]:
    """Return a change as a share of the tolerance, and of the noise floor of the tests on either side; None where not known."""
    low, high = series.low, series.high
    width = high - low if low is not None and high is not None else high if low is None else low
    floors = [r.floor for r in chart.regimes if first in (r.first, r.last + 1) and r.floor > 0.0]
    return {
        "of_tolerance": abs(change / width) if width else None,
        "of_floor": abs(change) / max(floors) if floors else None,
    }


def _sure(step: float, expanded: float) -> bool:
    """Return whether a step is more than its uncertainty, where that is known."""
    return not abs(step) <= expanded


def _limit_ahead(series: Series, regime: Regime) -> float | None:
    if math.isnan(regime.slope):
        return None
    return series.high if regime.slope > 0 else series.low


def _told_crossing(ahead: tuple[float, float, float] | None, limit: float | None, days: Any) -> dict[str, Any] | None:
    """Return when the limit is crossed as days, None when that is further ahead than is worth telling."""
    if ahead is None or ahead[1] > days[-1] + _LONGEST_FORECAST_DAYS:
        return None
    at, early, late = (min(day, days[-1] + _LONGEST_FORECAST_DAYS) for day in ahead)
    return {"limit": limit, "at": _day(at), "earliest": _day(max(early, days[-1])), "latest": _day(late)}


def _day(day: float) -> str:
    return (date(1970, 1, 1) + timedelta(days=math.floor(day))).isoformat()


def _signed(value: float, half: float) -> str:
    digits = decimals(half)
    known = f" ± {half:z.{digits}f}" if math.isfinite(half) else ""
    return f"{value:+z.{digits}f}{known}"
