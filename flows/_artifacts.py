"""What flows leave on the Prefect page: tables, findings, plots, links."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from prefect.artifacts import create_markdown_artifact, create_table_artifact

from dtwin.config import home
from dtwin.train.gates import Verdict
from dtwin.train.results import TrainingReport, condition_name
from flows import _plots
from flows.reach import running


def publish_table(key: str, head: Sequence[str], rows: Sequence[Sequence[object]], description: str) -> None:
    """Leave a table.

    Args:
        key: Tables of one key are versions of each other on the page.
        head: Column titles.
        rows: Cells.
        description: What it shows, in Markdown.
    """
    table = [{title: _cell(cell) for title, cell in zip(head, row, strict=True)} for row in rows]
    create_table_artifact(table or [{head[0]: "none"}], key=slug(key), description=description)


def publish_markdown(key: str, text: str, description: str) -> None:
    """Leave a page of Markdown.

    Args:
        key, description: As in :func:`publish_table`.
        text: The page.
    """
    create_markdown_artifact(text, key=slug(key), description=description)


def publish_findings(campaign: str, findings: Sequence[tuple[str, Mapping[str, Any]]], description: str) -> None:
    """Leave data-quality findings as a table, worst first.

    Args:
        campaign, description: What they belong to.
        findings: Findings as ``Finding.as_dict`` gives them.
    """
    order = ("error", "warning", "info")
    rows = sorted(
        ([f["severity"], f["code"], run or "campaign", f["message"]] for run, f in findings),
        key=lambda row: order.index(str(row[0])),
    )
    publish_table(f"findings-{campaign}", ("severity", "code", "run", "what"), rows, description)


def publish_held_out_error(report: TrainingReport) -> None:
    """Leave a plot of every candidate's held-out error.

    Args:
        report: A training.
    """
    rows = [(c.name, {"held-out RMS": c.held_out.rms_um}) for c in report.candidates]
    svg = _plots.bars(
        "error on conditions left out, µm RMS", rows, floor=report.noise_floor_um, longest=1.5 * report.rms_before_um
    )
    text = _plots.markdown("held-out error by candidate", svg)
    publish_markdown(f"held-out-error-{report.campaign}", text, f"Candidates trained on {report.campaign}")


def publish_version(machine: str, version: str, verdicts: Sequence[Verdict]) -> None:
    """Leave what the gates say of a version, and where to read more.

    Args:
        machine, version: The version.
        verdicts: What the gates say.
    """
    lines = [f"## Version {version} of {machine}", "", model_link(machine, version), ""]
    lines += [f"- {'pass' if v.passed else '**FAIL**'} {v.gate}: {v.reason}" for v in verdicts]
    publish_markdown(f"gates-{machine}", "\n".join(lines), f"Offline gates on version {version}")


def publish_evidence(machine: str, version: str, evidence: Mapping[str, Any]) -> None:
    """Leave a plot of compensated against uncompensated circles.

    Args:
        machine, version: The version.
        evidence: As ``Evidence.as_dict`` gives it.
    """
    rows = [
        (
            condition_name(c),
            {name: c[f"{name}_um"] for name in ("before", "oracle", "after") if c[f"{name}_um"] is not None},
        )
        for c in evidence["conditions"]
    ]
    svg = _plots.bars(f"error, µm ({evidence['kind']} evidence)", rows)
    publish_markdown(
        f"before-and-after-{machine}",
        _plots.markdown("before, oracle and after by condition", svg),
        f"Closed-loop evidence for version {version}, {evidence['clock']}",
    )


def model_link(machine: str, version: str) -> str:
    """Return a Markdown link to a version's page in MLflow, or how to get one.

    Args:
        machine, version: The version.
    """
    page = running(home()).get("mlflow")
    if page is None:
        return "The MLflow page of this version: `dtwin up`."
    return f"[Version {version} in MLflow]({page}/#/models/dtwin-{machine}/versions/{version})"


def _cell(value: object) -> str:
    """Return a cell that is no Markdown: a lone dash would be shown as a list."""
    return "n/a" if value in (None, "-") else str(value)


def slug(text: str) -> str:
    """Return a key as Prefect wants it: lower-case letters, digits and dashes.

    Args:
        text: Any text.
    """
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")
