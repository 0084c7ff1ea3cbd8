"""What was made of the runs of a campaign, kept in a file until they change, and what is noteworthy about them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from dtwin import __version__
from dtwin.acquire.amending import amendment_findings
from dtwin.acquire.quality import judge_campaign, said_together, without_samples
from dtwin.config import Home
from dtwin.documents import read_document, write_document
from dtwin.errors import StoreError
from dtwin.kinds.kind import Kind
from dtwin.kinds.registry import kinds
from dtwin.lake.rows import by_campaign, meta_of
from dtwin.lake.store import Lake
from dtwin.machine_record import tolerances_of
from dtwin.report.checking import campaign_sheet
from dtwin.report.uncertainty import Variation
from dtwin.schema import Finding, Run, require_name

_MADE_BY = f"{__version__} with what moves between there and back"
"""Changes when the same runs give other figures: what was kept before is made anew."""


def stamp_of(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return a hash of rows of the lake's table of runs: what they hold, and what was stated anew."""
    said = "".join(f"{row['content_sha256']} {row['metadata_version']}" for row in rows)
    return hashlib.sha256(said.encode()).hexdigest()


def kept(home: Home, what: str, campaign: str, stamp: str, make: Callable[[], Any]) -> Any:
    """Return what was made of the runs of a campaign: from its file when nothing changed since, else made now.

    ``what``: name of the folder that holds files of this sort.
    ``stamp``: of what it is made from.
    ``make``: returns something JSON-ready.
    """
    value = kept_already(home, what, campaign, stamp)
    if value is None:
        value = make()
        with suppress(StoreError):  # A home that cannot be written is read all the same.
            keep(home, what, campaign, stamp, value)
    return value


def kept_already(home: Home, what: str, campaign: str, stamp: str | None = None) -> Any:
    """Return what :func:`kept` keeps; None when there is nothing, or the runs changed since.

    ``stamp``: None takes what was made of other runs too.
    """
    path = _file_of(home, what, campaign)
    try:
        document = read_document(path) if path.exists() else {}
    except StoreError:
        return None
    return document.get("made") if stamp is None or document.get("stamp") == f"{_MADE_BY} {stamp}" else None


def keep(home: Home, what: str, campaign: str, stamp: str, made: Any) -> None:
    """Keep what was made of the runs of a campaign. Raises ``StoreError`` when the home cannot be written."""
    write_document(_file_of(home, what, campaign), {"stamp": f"{_MADE_BY} {stamp}", "made": made}, what)


def _file_of(home: Home, what: str, campaign: str) -> Path:
    return home.root / "kept" / what / f"{require_name(campaign, 'the campaign')}.json"


def variation_of(home: Home, machine: str, rows: Sequence[Mapping[str, Any]] | None = None) -> Variation | None:
    """Return how far readings of a machine move while it stands still, by its newest test that tells; else None.

    ``rows``: of all runs of the machine, where they were read before.
    """
    lake = Lake(home.lake)
    mine = lake.runs(machine=machine) if rows is None else [row for row in rows if row["left_out"] is None]
    telling = {kind.name: kind for kind in kinds() if kind.offers("variation")}
    of_campaign = by_campaign(row for row in mine if row["kind"] in telling)
    newest = sorted(of_campaign.items(), key=lambda item: item[1][0]["started"] or "", reverse=True)
    for name, told in newest:
        variation = kept(home, "surroundings", name, stamp_of(told), partial(_variation, lake, telling, name, told))
        if variation:
            return Variation(**variation)
    return None


def _variation(lake: Lake, telling: Mapping[str, Kind], name: str, rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the variation that a campaign tells, JSON-ready; empty when it tells none."""
    variation = telling[rows[0]["kind"]].variation([lake.load(dict(row), signals=False) for row in rows], name)
    return {} if variation is None else asdict(variation)


def sheet_of_campaign(
    home: Home, campaign: str, machine: str, stamp: str, variation: Variation | None
) -> dict[str, Any]:
    """Return the test sheet of a campaign of this machine, JSON-ready.

    ``stamp``: of its runs, as ``stamp_of`` gives it.
    ``variation``: of the machine, as ``variation_of`` gives it.
    """
    limits = tolerances_of(home, machine)
    return kept(
        home,
        "sheets",
        campaign,
        f"findings {stamp} {limits} {variation}",
        lambda: campaign_sheet(Lake(home.lake), campaign, limits, variation),
    )


SEVERITIES = ("error", "warning", "info")


def findings_of(row: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return what is noteworthy about a run."""
    return json.loads(row["findings_json"])


def campaign_findings(rows: Sequence[Mapping[str, Any]]) -> list[Finding]:
    """Return what is noteworthy about a campaign as a whole."""
    used = [Run(meta_of(row), {}) for row in rows if row["left_out"] is None]
    return [*judge_campaign(used), *amendment_findings(rows)]


def moving_findings(home: Home, campaign: str) -> list[dict[str, Any]]:
    """Return what samples of all runs together say against any model of a campaign of the lake: cycles that slip, spoilt readings, repeats that differ."""
    lake = Lake(home.lake)
    rows = lake.runs(campaign)
    light = [without_samples(lake.load(row, signals=False)) for row in rows]
    return [finding.as_dict() for finding in said_together(light)]


def grouped_findings(
    rows: Sequence[Mapping[str, Any]], together: Sequence[Mapping[str, Any]] = ()
) -> list[dict[str, Any]]:
    """Return the findings of all runs, one line for each code, the worst first.

    ``together``: what the samples of all of them say, as a test sheet has it.

    Each has ``severity``, ``code``, ``message`` of the first run, and ``runs``.
    """
    by_code: dict[str, dict[str, Any]] = {
        f"{f.code} {f.message}": {"severity": f.severity, "code": f.code, "message": f.message, "runs": []}
        for f in campaign_findings(rows)
    }
    by_code |= {f"{f['code']} {f['message']}": {**f, "runs": []} for f in together}
    for row in rows:
        for f in findings_of(row):
            entry = by_code.setdefault(f["code"], {**f, "runs": []})
            entry["runs"].append(row["run_id"])
    return sorted(by_code.values(), key=lambda f: (SEVERITIES.index(f["severity"]), f["code"]))
