"""Bring measurements into the lake."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from prefect import flow
from prefect.runtime import flow_run

from dtwin.acquire.ingest import IngestReport, worst
from flows import _artifacts, _tasks
from flows._paths import confined

_LONGEST_NAME = 80


def _run_name() -> str:
    """Return what a run of the flow is called."""
    return f"ingest {', '.join(Path(source).name for source in flow_run.parameters.get('sources', ()))}"[:_LONGEST_NAME]


@flow(name="ingest", flow_run_name=_run_name)
def ingest_flow(sources: list[Path]) -> dict[str, Any]:
    """Ingest campaign folders and ball-bar files, one task each; safe to repeat.

    Args:
        sources: Campaign folders, their ``campaign.toml``, or ``.b5r`` files.
    """
    reports = [_tasks.ingest(source) for source in map(confined, sources)]
    publish_ingest(reports)
    return {
        "campaigns": [report.campaign for report in reports],
        "added": sum(len(report.added) for report in reports),
        "unchanged": sum(len(report.unchanged) for report in reports),
        "rejected_rows": sum(report.rejected_rows for report in reports),
        "worst_finding": worst([found for report in reports for found in report.findings]),
        "table_versions": dict(reports[-1].versions) if reports else {},
    }


def publish_ingest(reports: Sequence[IngestReport]) -> None:
    """Leave what was ingested and what is wrong with it.

    Args:
        reports: One per source.
    """
    _artifacts.publish_table(
        "ingested",
        ("campaign", "runs added", "unchanged", "rows rejected", "worst finding"),
        [[r.campaign, len(r.added), len(r.unchanged), r.rejected_rows, worst(r.findings)] for r in reports],
        "What was brought into the lake",
    )
    for report in reports:
        _artifacts.publish_findings(
            report.campaign,
            [(run, finding.as_dict()) for run, finding in report.findings],
            f"Data quality of {report.campaign}",
        )
