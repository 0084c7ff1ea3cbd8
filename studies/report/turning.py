"""Surfaces of the virtual slide, without and with a correction, as text and figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import plotly.graph_objects as go

from dtwin.report.html import Section, Table
from dtwin.report.plots import COLOURS, styled
from dtwin.report.text import table
from dtwin.schema import Floats

_MOST_POINTS = 4000
_FIGURES = (
    ("form µm", "form_um", "z.3f"),
    ("phase deg", "phase_deg", "z.3f"),
    ("vector µm", "vector_um", "z.3f"),
    ("p-v µm", "peak_to_valley_um", "z.3f"),
)


@dataclass(frozen=True)
class Surface:
    """A cut surface along its spiral.

    ``x_mm``, ``turned_rad``, (n,): radius and spindle angle.
    ``wanted_um``, ``cut_um``, (n,): height as commanded and as cut.
    """

    x_mm: Floats
    turned_rad: Floats
    wanted_um: Floats
    cut_um: Floats


def trial_text(trial: Mapping[str, Any]) -> str:
    """Return surfaces without and with a correction for a terminal."""
    guard: dict[str, int] = {}
    for row in trial["rows"]:
        for name, count in row["guard"].items():
            guard[name] = guard.get(name, 0) + count
    acted = ", ".join(f"{name} {count}" for name, count in guard.items())
    worse = ", ".join(f"{f:g} Hz" for f in trial["worse"]) or "none"
    return "\n".join(
        [
            f"{trial['surface']}; at the rim; {trial['clock']}, slide {trial['truth']}",
            table(*_trial_table(trial)),
            f"frequencies that became worse: {worse}; guard, ticks: {acted}",
        ]
    )


def trial_section(trial: Mapping[str, Any], surfaces: Mapping[float, tuple[Surface, Surface]]) -> Section:
    """Return the section about surfaces without and with a correction.

    ``trial``: from ``studies.bicuspid.trial``.
    ``surfaces``: without and with, by frequency; may be empty.
    """
    figures = _trial_figures(trial["rows"])
    if surfaces:
        figures += _surface_figures(max(surfaces), surfaces[max(surfaces)])
    return Section(
        "Surfaces without and with the correction",
        [
            f"Bicuspid surface {trial['surface']}. Form and phase error are those of the rim; vector is "
            f"the length of the difference of both sines. {trial['clock']}; virtual slide: "
            f"{trial['truth']}."
        ],
        [("warning", f"{r['frequency_hz']:g} Hz: {r['alarm']}") for r in trial["rows"] if r["alarm"]],
        [Table(*_trial_table(trial))],
        figures,
    )


def _trial_table(trial: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Return head and rows of surfaces without and with a correction.

    ``trial``: from ``studies.bicuspid.trial``.
    """
    head = ["Hz", "rpm", *(f"{title}: without, with" for title, _, _ in _FIGURES), "alarm"]
    rows = []
    for row in trial["rows"]:
        cells = [
            f"{row['before'][key]:{form}}, {row['after'][key]:{form}} ({-100.0 * row['reduction'][key]:+z.1f} %)"
            for _, key, form in _FIGURES
        ]
        rows.append([f"{row['frequency_hz']:g}", f"{row['spindle_rpm']:g}", *cells, row["alarm"] or "-"])
    return head, rows


def _trial_figures(rows: Sequence[Mapping[str, Any]]) -> list[go.Figure]:
    """Return form and phase error over the tool's frequency, without and with.

    ``rows``: ``rows`` of ``studies.bicuspid.trial``.
    """
    frequency = [row["frequency_hz"] for row in rows]
    figures = []
    for key, title in (("form_um", "Form error at the rim, µm"), ("phase_deg", "Phase error at the rim, deg")):
        figure = go.Figure()
        for when, name, colour in (("before", "without", COLOURS["measured"]), ("after", "with", COLOURS["second"])):
            figure.add_trace(
                go.Scatter(
                    x=frequency,
                    y=[row[when][key] for row in rows],
                    name=name,
                    mode="lines+markers",
                    marker={"size": 9},
                    line={"color": colour},
                )
            )
        figure.update_layout(
            title=title,
            xaxis={"title": "frequency of the tool, Hz"},
            yaxis={"type": "log", "dtick": 1, "exponentformat": "none"},
        )
        figures.append(styled(figure))
    return figures


def _surface_figures(frequency_hz: float, cut: tuple[Surface, Surface]) -> list[go.Figure]:
    """Return the height error over the face at one frequency, without and with, on one scale."""
    largest = float(np.max(np.abs(cut[0].cut_um - cut[0].wanted_um)))
    figures = []
    for surface, title in zip(cut, ("without", "with"), strict=True):
        # Drawn at random: a fixed step would meet the turn at a few angles only.
        some = np.random.default_rng(0).integers(0, len(surface.x_mm), _MOST_POINTS)
        x, angle = surface.x_mm[some], surface.turned_rad[some]
        error = (surface.cut_um - surface.wanted_um)[some]
        figure = go.Figure(
            go.Scatter(
                x=np.round(x * np.cos(angle), 4),
                y=np.round(x * np.sin(angle), 4),
                mode="markers",
                marker={
                    "color": np.round(error, 4),
                    "size": 5,
                    "cmin": -largest,
                    "cmax": largest,
                    "colorscale": "RdBu",
                    "colorbar": {"title": "um"},
                },
                hovertemplate="x %{x} mm, y %{y} mm: %{marker.color} µm<extra></extra>",
            )
        )
        figure.update_layout(
            title=f"Height error at {frequency_hz:g} Hz, {title} correction",
            xaxis={"title": "mm"},
            yaxis={"title": "mm", "scaleanchor": "x"},
        )
        figures.append(styled(figure))
    return figures
