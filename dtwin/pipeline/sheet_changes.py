"""What changed in a machine from one test to the next: figures of two test sheets side by side."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from statistics import NormalDist
from typing import Any

from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.kinds.registry import kind_named
from dtwin.lake.store import Lake
from dtwin.machine_record import events_between, events_of
from dtwin.pipeline.campaign_certificate import earlier_test, when
from dtwin.pipeline.kept import sheet_of_campaign, stamp_of, variation_of
from dtwin.pipeline.machine_history import instrument_of, record_of
from dtwin.report.sheet import number_of

_CHANGED, _SAME, OPEN = "changed", "not changed", "cannot be said"
_FALSE_ALARMS = 0.05
_LOOKED_AT = 12
_COVERAGE_FACTOR = 2.0


def last_changes(home: Home, machine: str) -> dict[str, Any]:
    """Return what changed in the newest test of a machine that can be compared with an earlier one.

    Raises ``InputError`` when the machine is not known, or no test of it has an earlier one with a figure in common.
    """
    rows = [row for row in Lake(home.lake).runs(machine=machine) if kind_named(row["kind"]).offers("sheet")]
    record_of(home, machine, rows)
    begun: dict[str, tuple[str, str, str]] = {}
    for row in rows:
        begun[row["campaign"]] = min(begun.get(row["campaign"], when(row)), when(row))
    for name in sorted(begun, key=lambda name: begun[name], reverse=True)[:_LOOKED_AT]:
        with suppress(_First):
            return sheet_changes(home, name)
    raise _First(
        "there are not two tests with a figure in common",
        code="changes.first",
        where=machine,
        got=", ".join(list(begun)[:6]) or "none",
        hint="figures are compared under one condition: measure again as in one of these tests",
    )


class _First(InputError):
    """No earlier test can be compared with."""


def sheet_changes(home: Home, campaign: str, earlier: str = "", machine: str = "") -> dict[str, Any]:
    """Return the figures of a campaign beside those of an earlier test of its machine, JSON-ready.

    ``changed`` is what differs by more than chance explains in one of twenty comparisons, all figures together (Bonferroni), also
    when all that the budgets assume, because nobody stated it, were twice as large.
    ``not changed`` is what differs by no more than the uncertainty of the difference (k = 2), where that is smaller than
    the figure itself. Of the rest nothing can be said: of figures without an uncertainty, or with one as large as they are, and of
    those whose zero is that of a length of which nobody stated a calibration.

    ``earlier``: the campaign to compare with; without it the last one of the same kind and machine before this one.
    ``machine``: of which it must be; any without.
    Returns ``machine``, ``kind``, ``campaign``, ``earlier``; ``days`` of both; ``events`` recorded between them;
    ``instruments`` of both, empty where not stated; ``figures``; ``counts`` of what is said; ``alone``: figures that
    one of them has.
    Raises ``InputError`` when there is no such campaign, no earlier one, or one of another kind or machine.
    """
    lake = Lake(home.lake)
    known = lake.campaign(campaign)
    if machine not in ("", known.machine):
        raise InputError(
            "the campaign is of another machine",
            code="machine.campaign",
            where=campaign,
            got=known.machine,
            allowed=machine,
        )
    kind_named(known.kind).require("sheet")
    every = lake.runs(left_out=True, machine=known.machine)
    variation = variation_of(home, known.machine, every)

    def sheet(name: str) -> dict[str, Any]:
        stamp = stamp_of([row for row in every if row["campaign"] == name])
        return sheet_of_campaign(home, name, known.machine, stamp, variation)

    mine = [row for row in every if row["campaign"] == campaign]
    if earlier:
        other = lake.campaign(earlier)
        if (other.machine, other.kind) != (known.machine, known.kind) or earlier == campaign:
            raise InputError(
                "only tests of one kind and machine are compared",
                code="changes.other",
                where=campaign,
                got=f"{earlier}, {other.kind} of {other.machine}",
                allowed=f"another {known.kind} campaign of {known.machine}",
            )
        before: dict[str, Any] = {"campaign": earlier, "sheet": sheet(earlier)}
    else:
        of_then = earlier_test(home, every, mine, sheet(campaign), variation)
        if of_then is None:
            raise _First(
                "there is no earlier test with a figure in common",
                code="changes.first",
                where=campaign,
                got=f"{known.kind} of {known.machine}",
                hint=f"dtwin machine show {known.machine}",
            )
        before = of_then
    old, new = _figures(before["sheet"]), _figures(sheet(campaign))
    both = [key for key in new if key in old]
    critical = NormalDist().inv_cdf(1.0 - _FALSE_ALARMS / 2.0 / max(len(both), 1))
    figures = [_compared(key, old[key], new[key], max(critical, _COVERAGE_FACTOR)) for key in both]
    days = [
        min((r["started"] for r in every if r["campaign"] == n and r["started"]), default="")
        for n in (before["campaign"], campaign)
    ]
    events = events_between(events_of(home, known.machine), *sorted(days)) if all(days) else []
    instruments = [
        instrument_of([row for row in every if row["campaign"] == name]) for name in (before["campaign"], campaign)
    ]
    return {
        "machine": known.machine,
        "kind": known.kind,
        "campaign": campaign,
        "earlier": before["campaign"],
        "unit": before["sheet"]["unit"],
        "days": [day[:10] for day in days],
        "events": [event.as_dict() for event in events],
        "instruments": instruments,
        "figures": sorted(figures, key=lambda one: (_CHANGED, OPEN, _SAME).index(one["said"])),
        "counts": dict(Counter(one["said"] for one in figures)),
        "alone": [
            f"{symbol}, {title}"
            for title, symbol in [*old, *new]
            if ((title, symbol) in old) != ((title, symbol) in new)
        ],
    }


def _figures(sheet: Mapping[str, Any]) -> dict[tuple[str, str], dict[str, Any]]:
    return {(part["title"], c["symbol"]): c for part in sheet["parts"] for c in part["characteristics"]}


def _compared(key: tuple[str, str], old: Mapping[str, Any], new: Mapping[str, Any], critical: float) -> dict[str, Any]:
    unit = new["unit"]
    difference = float(number_of(new, "value")) - float(number_of(old, "value"))
    known = number_of(old, "expanded") is not None and number_of(new, "expanded") is not None
    k2 = math.hypot(number_of(old, "expanded"), number_of(new, "expanded")) if known else None
    budgets = [c for one in (old, new) for c in (one["budget"] or {"contributions": ()})["contributions"]]
    assumed = [c for c in budgets if c["assumed"]]
    said = OPEN
    if k2 is not None and not any(c["zero"] for c in assumed):
        # With what was assumed twice as large: its variance four times.
        widest = math.hypot(k2 / _COVERAGE_FACTOR, *(math.sqrt(3.0) * float(c[f"standard_{unit}"]) for c in assumed))
        if abs(difference) > critical * widest:
            said = _CHANGED
        elif abs(difference) <= k2 < max(abs(float(number_of(old, "value"))), abs(float(number_of(new, "value")))):
            said = _SAME
    return {
        "condition": key[0],
        "symbol": key[1],
        "name": new["name"],
        "unit": unit,
        f"before_{unit}": number_of(old, "value"),
        f"before_k2_{unit}": number_of(old, "expanded"),
        f"now_{unit}": number_of(new, "value"),
        f"now_k2_{unit}": number_of(new, "expanded"),
        "shown": [f"{c['shown']['value']} {c['shown']['expanded']}".removesuffix(" -") for c in (old, new)],
        f"difference_{unit}": difference,
        f"difference_k2_{unit}": k2,
        "assumed": sorted({c["source"] for c in assumed}),
        "said": said,
    }
