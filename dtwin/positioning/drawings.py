"""Figures of one run of a positioning test."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from dtwin.kinds.kind import Drawing
from dtwin.report.plots import error_figure, lacks_columns
from dtwin.schema import Run

if TYPE_CHECKING:
    import plotly.graph_objects as go


def _along(run: Run, floor_um: Callable[[], float]) -> go.Figure:
    """Draw the sweeps over their positions."""
    if not {"position_mm", "direction", "error_um"} <= set(run.samples):
        raise lacks_columns(run, "error over a position", "position_mm, direction, error_um")
    position, error = (np.asarray(run.samples[n], float) for n in ("position_mm", "error_um"))
    ways = np.asarray(run.samples["direction"])
    curves = {str(way): (position[ways == way], error[ways == way]) for way in np.unique(ways)}
    title = f"{run.meta.run_id}: error as measured"
    return error_figure(curves, title=title, x_title="position, mm")


DRAWINGS = (Drawing("along", "Error of the run along its path", 520, _along),)
