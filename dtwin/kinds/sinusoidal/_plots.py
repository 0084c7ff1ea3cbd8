"""Figures of turned surfaces, without and with a correction."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import plotly.graph_objects as go

from dtwin.kinds.kind import Drawing
from dtwin.kinds.sinusoidal._grid import TONE, tone_row
from dtwin.report.plots import error_figure
from dtwin.schema import Run

if TYPE_CHECKING:
    import plotly.graph_objects as go


def _along(run: Run, floor_um: Callable[[], float]) -> go.Figure:
    """Draw the tool over the phase of its command."""
    curves = {"tool minus command": (TONE.points, tone_row(run, 0.0).y_um)}
    title = f"{run.meta.run_id}: error as measured"
    return error_figure(curves, title=title, x_title="phase of the command, deg")


DRAWINGS = (Drawing("along", "Error of the run along its path", 520, _along),)
