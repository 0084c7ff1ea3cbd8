"""A machine: its record, its tests in the order of their days, its twins and its champion."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.kinds.registry import kind_named
from dtwin.lake.store import Lake
from dtwin.machine_record import MachineRecord, read_record, recorded
from dtwin.progress import Progress
from dtwin.report.checking import campaign_sheet
from dtwin.serve.pointer import resolve
from dtwin.twins.of_kind import every_shelf

SheetOf = Callable[[str], dict[str, Any]]


def machine_overviews(home: Home) -> list[dict[str, Any]]:
    """Return every machine that has a record or a campaign, JSON-ready, by name."""
    rows = Lake(home.lake).runs()
    twins = _twins(home)
    names = sorted({*recorded(home), *(row["machine"] for row in rows)})
    return [_overview(home, name, [r for r in rows if r["machine"] == name], twins.get(name, [])) for name in names]


def machine_history(
    home: Home, machine: str, progress: Progress | None = None, sheet_of: SheetOf | None = None
) -> dict[str, Any]:
    """Return what is known of a machine, with the test sheet of each of its campaigns, JSON-ready.

    Parameters
    ----------
    home : Home
        Of the lake, the records, the twins and the bundles.
    sheet_of : callable, optional
        Returns the test sheet of a campaign where it is kept; else it is made of the runs.

    Raises
    ------
    InputError
        When there is neither a record nor a campaign of it.
    """
    lake = Lake(home.lake)
    rows = [row for row in lake.runs() if row["machine"] == machine]
    record = read_record(home, machine)
    if record is None and not rows:
        known = ", ".join(found["machine"] for found in machine_overviews(home)) or "none"
        raise InputError("no such machine", code="machine.unknown", got=machine, allowed=known)
    record = record or MachineRecord(machine)
    starts = {row["campaign"]: (row["started"] or "", row["kind"]) for row in reversed(rows)}
    tests = []
    for done, (name, (started, kind)) in enumerate(sorted(starts.items(), key=lambda item: item[1]), start=1):
        test: dict[str, Any] = {"campaign": name, "kind": kind, "started": started, "sheet": None}
        if kind_named(kind).offers("sheet"):
            test["sheet"] = campaign_sheet(lake, name, record.tolerances) if sheet_of is None else sheet_of(name)
        tests.append(test | _headline(test["sheet"]))
        if progress is not None:
            progress(done, len(starts), name)
    return {
        **_overview(home, machine, rows, _twins(home).get(machine, [])),
        "facts": dict(record.facts),
        "axes": record.as_dict()["axes"],
        "tolerances": record.as_dict()["tolerances"],
        "events": record.as_dict()["events"],
        "tests": tests,
        "champion": _champion(home, machine),
    }


def _overview(home: Home, machine: str, rows: Sequence[dict[str, Any]], twins: Sequence[str]) -> dict[str, Any]:
    record = read_record(home, machine)
    return {
        "machine": machine,
        "type": "" if record is None else record.facts.get("type", ""),
        "campaigns": sorted({row["campaign"] for row in rows}),
        "last_test": max((row["started"] or "" for row in rows), default="")[:10],
        "twins": list(twins),
    }


def _headline(sheet: dict[str, Any] | None) -> dict[str, Any]:
    """Return the first figure of the condition where it is largest, and the decision of the whole sheet."""
    parts = [part for part in (sheet or {"parts": []})["parts"] if part["characteristics"]]
    if sheet is None or not parts:
        return {
            "figure": "",
            "condition": "",
            "value_um": None,
            "expanded_um": None,
            "limit_um": None,
            "shown": "",
            "decision": "",
        }
    symbol = sheet["headline"]
    told = [(c, p) for p in parts for c in p["characteristics"] if c["symbol"] == symbol]
    told = told or [(p["characteristics"][0], p) for p in parts]
    largest, part = max(told, key=lambda pair: abs(float(pair[0]["value_um"])))
    shown = f"{largest['shown']['value']} {largest['shown']['expanded']}".removesuffix(" -")
    return {
        "figure": largest["symbol"],
        "condition": part["title"],
        "value_um": largest["value_um"],
        "expanded_um": largest["expanded_um"],
        "limit_um": largest["high_um"],
        "shown": shown,
        "decision": sheet["verdict"],
    }


def _twins(home: Home) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for shelf in every_shelf(home):
        for name in shelf.names():
            rungs = shelf.history(name)
            if rungs:
                found.setdefault(str(rungs[-1].get("machine", "")), []).append(name)
    return found


def _champion(home: Home, machine: str) -> str:
    try:
        return resolve("latest", machine, home, harmless=True).describe()
    except InputError:
        return ""
