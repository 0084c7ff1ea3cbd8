"""What thermal models do in a campaign, as a page to look at, and the pictures of a cycle."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
import plotly.graph_objects as go

from dtwin.kinds.kind import Drawing
from dtwin.kinds.volumetric._text import finding_lines
from dtwin.report.html import Section, Table, page
from dtwin.report.plots import COLOURS, draw_line, lacks_columns, places_figure, styled
from dtwin.schema import Run

_DRAWN = {f"{axis}_mm" for axis in "xyz"} | {f"error_{axis}_um" for axis in "xyz"}


def _seen(run: Run, floor_um: Callable[[], float], axes: tuple[str, str]) -> go.Figure:
    """Draw how far the machine was off at each ball of a cycle."""
    if not set(run.samples) >= _DRAWN:
        raise lacks_columns(run, "error at places", ", ".join(sorted(_DRAWN)))
    off = np.sqrt(sum(run.samples[f"error_{axis}_um"] ** 2 for axis in "xyz"))
    across, up = (run.samples[f"{axis.lower()}_mm"] for axis in axes)
    return places_figure(across, up, off, title=f"Error at the balls, {axes[0]} and {axes[1]}", axes=axes)


DRAWINGS = (
    Drawing("above", "Error at the balls, seen from above", 460, partial(_seen, axes=("X", "Y")), half=True),
    Drawing("front", "Error at the balls, seen from the front", 460, partial(_seen, axes=("X", "Z")), half=True),
)


def volumetric_page(result: Mapping[str, Any]) -> str:
    """Return what ``judged`` found as a page that holds everything it shows."""
    d = result["distances"]
    told = [("note", line) for line in finding_lines(result)] or [("note", "nothing to warn of")]
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
