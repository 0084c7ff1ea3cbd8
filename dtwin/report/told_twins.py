"""What twins that are told in words and tables have in common in reports: their path is no circle and no stroke."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from dtwin.report.html import Section
from dtwin.report.text import table
from dtwin.report.twin_plots import ranked_figure, waterfall_figure
from dtwin.report.twins import history_text


def candidate_table(candidates: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the table of what may be missing; nothing for none."""
    rows = [
        (c["label"], f"{100 * c['cv_gain']:z.1f} %", f"{c['p_value']:.1g}", "yes" if c["in_group"] else "")
        for c in candidates
    ]
    return [table(("effect", "gain held out", "p", "in group"), rows)] if rows else []


def missing_section(result: Mapping[str, Any], told: str, severity: str = "warning", said: str = "") -> Section:
    """Return a diagnosis for a report; ``told``: its text for the terminal."""
    figures = [ranked_figure(result)] if result["candidates"] else []
    return Section("What is missing", [], [(severity, said or result["headline"])], [], figures, [told])


def history_section(rungs: Sequence[Mapping[str, Any]]) -> Section:
    """Return the versions of a twin for a report."""
    figure = waterfall_figure(rungs, begun="no effects")
    return Section("From version to version", figures=[figure], code=[history_text(rungs)])
