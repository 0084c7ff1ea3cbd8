"""Figures of turned surfaces, without and with a correction."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import plotly.graph_objects as go

from dtwin.kinds.kind import Drawing
from dtwin.kinds.sinusoidal._grid import TONE, tone_row
from dtwin.report.plots import COLOURS, error_figure, styled
from dtwin.schema import Floats, Run

if TYPE_CHECKING:
    import plotly.graph_objects as go


_MOST_POINTS = 4000


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


def trial_figures(rows: Sequence[Mapping[str, Any]]) -> list[go.Figure]:
    """Return form and phase error over the tool's frequency, without and with.

    ``rows``: ``rows`` of ``dtwin.kinds.sinusoidal.trial.trial``.
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


def surface_figures_of(frequency_hz: float, cut: tuple[Surface, Surface]) -> list[go.Figure]:
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


def _along(run: Run, floor_um: Callable[[], float]) -> go.Figure:
    """Draw the tool over the phase of its command."""
    curves = {"tool minus command": (TONE.points, tone_row(run, 0.0).y_um)}
    title = f"{run.meta.run_id}: error as measured"
    return error_figure(curves, title=title, x_title="phase of the command, deg")


DRAWINGS = (Drawing("along", "Error of the run along its path", 520, _along),)
