"""What is noteworthy about runs of the lake; only :func:`moving_findings` reads samples."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from dtwin.acquire.amending import amendment_findings
from dtwin.acquire.quality import judge_campaign, said_together, without_samples
from dtwin.config import Home
from dtwin.lake.rows import meta_of
from dtwin.lake.store import Lake
from dtwin.schema import Finding, Run

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
