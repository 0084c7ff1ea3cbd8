"""Text and page of a campaign's dynamic parts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import plotly.graph_objects as go

from dtwin.report.html import Section, Table, page
from dtwin.report.plots import COLOURS, draw_line, error_figure, polar_figure, styled
from dtwin.report.text import table
from dtwin.schema import Floats
from dtwin.units import shown_number

Curves = Mapping[str, tuple[Floats, Floats, Floats]]
_HEAD = ("run", "feed", "way", "CD before", "CD after", "DC1", "DC2", "DC3", "to reference", "accelerometer, mg")
_WHAT_THEY_ARE = (
    "um. CD: circular deviation about the least-squares circle. DC1: CD before minus CD after. DC2, "
    "DC3: peak to peak and RMS of what was taken out. To reference: relative difference of CD after "
    "to the slow runs. The last row is what the same way takes out of the slow runs: it is no vibration."
)


def dynamics_text(result: Mapping[str, Any]) -> str:
    """Return the dynamic parts of a campaign as text."""
    lines = [
        f"{result['campaign']}: {result['filter']}",
        f"reference {result['reference_feed_mm_min']:g} mm/min, {result['readings']} readings per revolution",
        table(_HEAD, [*_rows(result), _bias_row(result)]),
        _WHAT_THEY_ARE,
        *(f"{f['severity']}: {f['message']}" for f in result["findings"]),
    ]
    if result.get("left_out"):
        lines.append(f"left out, with errors at ingest: {', '.join(result['left_out'])}")
    if result["tuning"]:
        lines.insert(1, _tuned(result["tuning"]))
    return "\n".join(lines)


def dynamics_page(result: Mapping[str, Any], curves: Curves, radius_mm: float) -> str:
    """Return the dynamic parts of a campaign as a page that holds everything it shows."""
    findings = [(f["severity"], f["message"]) for f in result["findings"]]
    paragraphs = [_tuned(result["tuning"])] if result["tuning"] else []
    sections = [
        Section("What to know first", paragraphs, findings or [("note", "nothing to warn of")]),
        Section("By feed", (), figures=[_by_feed(result), _taken_figure(curves)]),
        Section(
            "Fastest run before and after",
            figures=[
                polar_figure({"before": (angle, before), "after": (angle, after)}, radius_mm, title=way)
                for way, (angle, before, after) in curves.items()
            ],
        ),
    ]
    if result["alpha"]:
        sections.append(
            Section(
                "What alpha does",
                ["Circular deviation of the fastest run after the filter, for both models."],
                figures=[_alpha_figure(result["alpha"])],
            )
        )
    rows = [[_text(cell) for cell in row] for row in [*_rows(result), _bias_row(result)]]
    sections.append(Section("Every run", [_WHAT_THEY_ARE], tables=[Table(_HEAD, rows)]))
    subtitle = (
        f"{result['filter']}; reference {result['reference_feed_mm_min']:g} mm/min; "
        f"{result['readings']} readings per revolution"
    )
    return page(f"Dynamics of {result['campaign']}", subtitle, sections)


def _rows(result: Mapping[str, Any]) -> list[list[object]]:
    return [
        [
            r["run"],
            r["feed_mm_min"],
            r["direction"],
            *(f"{r[k]:z.2f}" for k in ("before_um", "after_um", "dc1_um", "dc2_um", "dc3_um")),
            f"{100 * r['difference']:z.1f} %",
            " ".join(f"{1e3 * v:z.2f}" for v in r["accelerometer_rms_g"].values()) or "-",
        ]
        for r in result["rows"]
    ]


def _bias_row(result: Mapping[str, Any]) -> list[object]:
    bias = [f"{result['bias'][k]:z.2f}" for k in ("dc1_um", "dc2_um", "dc3_um")]
    return ["slow runs", result["reference_feed_mm_min"], "", "", "", *bias, "", ""]


def _tuned(tuning: Mapping[str, Any]) -> str:
    said = (
        f"tuned {tuning['tuned']} by {tuning['fitness']}: fitness "
        f"{shown_number(tuning['unfiltered']['fitness'])} without, {shown_number(tuning['judged']['fitness'])} with; "
        f"{tuning['evaluations']} filters tried"
    )
    if tuning["inert"]:
        said += "; it makes no difference to this model: nothing was found"
    return said + (f"; MLflow run {tuning['mlflow_run']}" if "mlflow_run" in tuning else "")


def _by_feed(result: Mapping[str, Any]) -> go.Figure:
    figure = go.Figure()
    feeds = sorted({r["feed_mm_min"] for r in result["rows"]})
    looks = (
        ("CD before", "before_um", COLOURS["measured"]),
        ("CD after", "after_um", COLOURS["second"]),
        ("DC2", "dc2_um", COLOURS["third"]),
        ("DC3", "dc3_um", COLOURS["fourth"]),
    )
    for name, key, colour in looks:
        means = [float(np.mean([r[key] for r in result["rows"] if r["feed_mm_min"] == f])) for f in feeds]
        draw_line(figure, feeds, means, name, mode="lines+markers", color=colour)
    figure.update_layout(
        title="Mean of the runs of each feed", xaxis_title="feed, mm/min", yaxis={"title": "um", "rangemode": "tozero"}
    )
    return styled(figure)


def _taken_figure(curves: Curves) -> go.Figure:
    taken = {}
    for way, (angle, before, after) in curves.items():
        order = np.argsort(angle % 360.0)
        taken[way] = ((angle % 360.0)[order], (before - after)[order])
    return error_figure(taken, title="What was taken out of the fastest run")


def _alpha_figure(found: Mapping[str, Any]) -> go.Figure:
    figure = go.Figure()
    for colour, (model, values) in zip(
        (COLOURS["measured"], COLOURS["second"]), ((k, v) for k, v in found.items() if k != "alpha"), strict=True
    ):
        draw_line(figure, found["alpha"], values, model, mode="lines+markers", color=colour)
    figure.update_layout(
        title="Sensitivity to alpha",
        xaxis={"title": "alpha", "type": "log", "dtick": 1, "exponentformat": "power"},
        yaxis_title="circular deviation after, µm",
    )
    return styled(figure)


def _text(cell: object) -> str:
    return f"{cell:g}" if isinstance(cell, float) else str(cell)
