"""The certificate of a campaign in the lake: its sheet with all that is known of machine, instrument and runs."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from typing import Any

from dtwin import __version__
from dtwin.config import Home
from dtwin.kinds.registry import kind_named
from dtwin.lake.rows import campaign_of
from dtwin.lake.store import Lake
from dtwin.machine_record import MachineRecord, read_record
from dtwin.pipeline.kept import grouped_findings, sheet_of_campaign, stamp_of, variation_of
from dtwin.pipeline.machine_history import instrument_of
from dtwin.report.certificate import certificate_page
from dtwin.report.language import Language
from dtwin.report.sheet import notes_beside
from dtwin.report.uncertainty import Variation
from dtwin.schema import of_one_way

# So many earlier tests are looked at for a figure in common, the newest first.
_LOOKED_AT = 12


def certificate(home: Home, campaign: str, language: str = "en") -> str:
    """Return the certificate of a campaign as one HTML page.

    Raises ``InputError`` when there is no such campaign, it has no sheet, or the language is not known.
    """
    Language(language)
    lake = Lake(home.lake)
    mine = lake.runs(campaign, left_out=True)
    known = campaign_of(mine) if mine else lake.campaign(campaign)
    kind = kind_named(known.kind)
    kind.require("sheet")
    every = lake.runs(left_out=True, machine=known.machine)
    variation = variation_of(home, known.machine, every)
    sheet = sheet_of_campaign(home, campaign, known.machine, stamp_of(mine), variation)
    used = {name for part in sheet["parts"] for name in part["runs"]}
    runs = {row["run_id"]: lake.load(row, signals=False) for row in mine if row["run_id"] in used}
    figures = [kind.sheet_figure([runs[name] for name in part["runs"]]) for part in sheet["parts"]]
    told = [(f["severity"], f["message"]) for f in grouped_findings(mine, sheet["findings"]) if f["severity"] != "info"]
    sheet = sheet | {"notes": notes_beside(sheet)}
    earlier = earlier_test(home, every, mine, sheet, variation)
    return certificate_page(facts_of(home, mine), sheet, figures, told, earlier=earlier, language=language)


def facts_of(home: Home, rows: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Return what stands at the head of a document about a test; ``rows``: of its runs."""
    known = campaign_of(rows)
    record = read_record(home, known.machine) or MachineRecord(known.machine)
    stated = {name: str(value) for name, value in known.instrument.items()}
    stamps = sorted(row["started"][:16].replace("T", " ") for row in rows if row["started"])
    temperatures = [t for row in rows if (t := json.loads(row["covariates_json"]).get("temperature_c")) is not None]
    temperature = (
        " - ".join(dict.fromkeys(f"{t:z.1f}" for t in (min(temperatures), max(temperatures)))) + " °C"
        if temperatures
        else ""
    )
    return {
        "campaign": known.name,
        "machine": known.machine,
        "type": record.facts.get("type", ""),
        "serial": record.facts.get("serial", ""),
        "controller": record.facts.get("controller", ""),
        "instrument": instrument_of(rows) or _one_that_can(record.facts.get("instruments", ""), known.kind),
        "certificate": stated.get("certificate", ""),
        "calibrated": stated.get("calibrated_on", ""),
        "operator": stated.get("operator", ""),
        "temperature": temperature,
        "measured": _span(stamps),
        "test": known.name,
        "runs": str(len(of_one_way([r for r in rows if r["left_out"] is None]))),
        "evaluated by": f"dtwin {__version__}",
    }


def _one_that_can(instruments: str, kind: str) -> str:
    """Return the one of the instruments of a machine that makes tests of a kind; empty where none does, or several."""
    apart = re.split(r"\s*[;\n]\s*" if re.search(r"[;\n]", instruments) else r"\s*,\s*", instruments)
    names = kind_named(kind).measured_by
    able = [
        one for one in apart if any(name in re.sub(r"[-\u2010\u2011]| (?=bar)", "", one.casefold()) for name in names)
    ]
    return able[0] if len(able) == 1 else ""


def _span(stamps: Sequence[str]) -> str:
    """Return from when to when, of days with or without a time, in order; empty of none."""
    if not stamps or stamps[0] == stamps[-1]:
        return "".join(stamps[:1])
    first, last = stamps[0], stamps[-1]
    if first[:10] != last[:10]:
        return f"{first} - {last}"
    return f"{first} - {last[11:]}" if len(first) > 10 else first


def earlier_test(
    home: Home,
    rows: Sequence[Mapping[str, Any]],
    mine: Sequence[Mapping[str, Any]],
    sheet: Mapping[str, Any],
    variation: Variation | None,
) -> dict[str, Any] | None:
    """Return name and sheet of the last test of the same kind and machine before this one with a figure in common.

    ``rows``: of all runs of the machine; ``mine``: those of the test, whose ``sheet`` this is.
    """
    with_day = any(row["started"] for row in mine)
    first = min(when(row) for row in mine if bool(row["started"]) == with_day)
    begun: dict[str, tuple[str, str, str]] = {}
    for row in rows:
        alike = (row["machine"], row["kind"]) == (mine[0]["machine"], mine[0]["kind"])
        if alike and bool(row["started"]) == with_day and row["campaign"] != mine[0]["campaign"] and when(row) < first:
            begun[row["campaign"]] = max(begun.get(row["campaign"], when(row)), when(row))
    figures = _figures(sheet)
    for name in sorted(begun, key=lambda name: begun[name], reverse=True)[:_LOOKED_AT]:
        stamp = stamp_of([row for row in rows if row["campaign"] == name])
        of_then = sheet_of_campaign(home, name, mine[0]["machine"], stamp, variation)
        if figures & _figures(of_then):
            return {"campaign": name, "sheet": of_then}
    return None


def _figures(sheet: Mapping[str, Any]) -> set[tuple[str, str]]:
    return {(part["title"], c["symbol"]) for part in sheet["parts"] for c in part["characteristics"]}


def when(row: Mapping[str, Any]) -> tuple[str, str, str]:
    """Return what orders runs in time: of tests that state the same start, or none, the one that came in first is earlier."""
    return str(row["started"] or ""), str(row["ingested"]), str(row["campaign"])
