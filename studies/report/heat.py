"""What thermal models do in a campaign, as text and page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import plotly.graph_objects as go

from dtwin.report.html import Section, Table, page
from dtwin.report.plots import COLOURS, draw_line, styled
from dtwin.report.text import table

_SHOWN_H = (1, 5, 12, 20, 60)


def judged_text(verdict: Mapping[str, Any]) -> str:
    """Return what thermal models do in a campaign."""
    d = verdict["distances"]
    lines = [
        f"{verdict['campaign']}: {verdict['cycles']} cycles, {verdict['sensors']} thermocouples; identification "
        f"leaves {verdict['identified_um']:z.2f} µm, {verdict['held_out_poses_um']:z.2f} µm in held-out poses",
        f"distances between balls: RMS {d['rms_um']:z.2f} -> {d['rms_left_um']:z.2f} µm "
        f"({-d['rms_reduction_pct']:z.0f} %), range {d['p2p_um']:z.0f} -> {d['p2p_left_um']:z.0f} µm "
        f"({-d['p2p_reduction_pct']:z.0f} %)",
    ]
    if verdict["dropped"]:
        lines.append(f"left out, for a cycle has no plausible readings of them: {', '.join(verdict['dropped'])}")
    if verdict["slots"]:
        s = verdict["slots"]
        lines.append(
            f"sixteen slots in 15 h: range {s['mean_range_um']:z.1f} -> {s['mean_range_left_um']:z.1f} µm on "
            f"average, {s['max_range_um']:z.1f} -> {s['max_range_left_um']:z.1f} µm at worst"
        )
    rows = [
        [
            r["name"],
            r["unit"],
            f"{r['rms_um']:z.2f}",
            f"{r['rms_left_um']:z.2f}",
            f"{r['rms_reduction_pct']:z.0f}",
            len(r["sensors"]),
            "yes" if r["memory"] else "",
            f"{r['largest_inflation']:z.0f}",
        ]
        for r in verdict["coefficients"]
    ]
    head = ("", "unit", "RMS", "left", "less %", "sensors", "memory", "inflation")
    lines += ["", table(head, rows), "", *_line_lines(verdict["lines"])]
    return "\n".join([*lines, *_finding_lines(verdict)])


def volumetric_page(result: Mapping[str, Any]) -> str:
    """Return what ``judged`` found as a page that holds everything it shows."""
    d = result["distances"]
    told = [("note", line) for line in _finding_lines(result)] or [("note", "nothing to warn of")]
    head = ("motion", "unit", "RMS", "left", "less, %", "temperatures")
    rows = [
        [
            r["name"],
            r["unit"],
            f"{r['rms_um']:z.2f}",
            f"{r['rms_left_um']:z.2f}",
            str(round(r["rms_reduction_pct"])),
            str(len(r["sensors"])),
        ]
        for r in result["coefficients"]
    ]
    sections = [
        Section("What to know first", (), told),
        Section("Error motions", (), figures=[_motions(result)]),
        Section(
            "How much the error changes within a job",
            ["Spread inside a job of that length along a line through the volume, less in 95 % of them."],
            figures=[_spread(result, direction) for direction in "XYZ"],
        ),
        Section("Every motion", (), tables=[Table(head, rows)]),
    ]
    subtitle = (
        f"{result['cycles']} cycles; distances between balls: RMS {d['rms_um']:z.2f} to "
        f"{d['rms_left_um']:z.2f} µm (-{d['rms_reduction_pct']:z.0f} %)"
    )
    return page(f"Heat in {result['campaign']}", subtitle, sections)


def _finding_lines(finding: Mapping[str, Any]) -> list[str]:
    """Return what is not explained, and what is worse than nothing, a line each."""
    lines = [_unexplained_line(entry) for entry in finding["unexplained"]]
    if finding["worse"]:
        lines.append(f"worse than nothing: {', '.join(finding['worse'])}")
    return lines


def _line_lines(lines: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a table of the spread within jobs, and where a correction makes it larger."""
    hours = lines[0]["hours"]
    shown = sorted({min(range(len(hours)), key=lambda i: abs(hours[i] - h)) for h in _SHOWN_H})
    rows = [
        [
            f"{line['line']}, error in {line['direction']}",
            *(f"{line['p95_um'][i]:z.1f} -> {line['p95_left_um'][i]:z.1f}" for i in shown),
        ]
        for line in lines
    ]
    head = ("line", *(f"{hours[i]:g} h" for i in shown))
    out = ["spread within a job of that length in µm, less in 95 % of them:", table(head, rows)]
    for line in lines:
        if line["worse_h"]:
            named = ", ".join(f"{h:g}" for h in line["worse_h"])
            out.append(f"line {line['line']}, error in {line['direction']}: worse than nothing in jobs of {named} h")
    return out


def _unexplained_line(entry: Mapping[str, Any]) -> str:
    left = ", ".join(f"{t['channel']} would leave {t['left_um']:z.2f}" for t in entry["tried"])
    if entry["cause"]:
        return (
            f"{entry['name']} is not explained by the thermocouples; {entry['cause']} explains it in both "
            f"campaigns ({left}): --offer {entry['cause']}"
        )
    told = f"nor by what else was logged ({left})" if left else "and no other campaign was given to look for a cause"
    return f"{entry['name']} is not explained by the thermocouples, {told}"


def _motions(result: Mapping[str, Any]) -> go.Figure:
    figure = go.Figure()
    names = [row["name"] for row in result["coefficients"]]
    for label, key, colour in (("measured", "rms_um", "measured"), ("left by the model", "rms_left_um", "second")):
        values = [row[key] for row in result["coefficients"]]
        figure.add_trace(go.Bar(x=names, y=values, name=label, marker_color=COLOURS[colour]))
    figure.update_layout(title="RMS of every error motion", yaxis_title="um, µm/m", barmode="group")
    return styled(figure)


def _spread(result: Mapping[str, Any], direction: str) -> go.Figure:
    figure = go.Figure()
    lines = [line for line in result["lines"] if line["direction"] == direction]
    for line, dash in zip(lines, ("solid", "dash", "dot"), strict=True):
        for label, key, colour in (("", "p95_um", "measured"), (", left", "p95_left_um", "second")):
            named = f"{line['line']} line{label}"
            draw_line(figure, line["hours"], line[key], named, mode=None, color=COLOURS[colour], dash=dash)
    figure.update_layout(
        title=f"Error in {direction}",
        xaxis={"title": "length of the job, h", "type": "log"},
        yaxis={"title": "um", "rangemode": "tozero"},
    )
    return styled(figure)
