"""Figures of one run of a positioning test."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from dtwin.kinds.kind import Drawing
from dtwin.positioning.ways import LENGTHS, Scale
from dtwin.report.plots import error_figure, lacks_columns
from dtwin.schema import Run

if TYPE_CHECKING:
    import plotly.graph_objects as go


def _along(run: Run, floor_um: Callable[[], float], scale: Scale = LENGTHS) -> go.Figure:
    """Draw the sweeps over their positions."""
    if not {scale.position, "direction", scale.error} <= set(run.samples):
        raise lacks_columns(run, "error over a position", f"{scale.position}, direction, {scale.error}")
    position, error = (np.asarray(run.samples[n], float) for n in (scale.position, scale.error))
    ways = np.asarray(run.samples["direction"])
    curves = {str(way): (position[ways == way], error[ways == way]) for way in np.unique(ways)}
    title = f"{run.meta.run_id}: error as measured"
    return error_figure(curves, title=title, x_title=f"position, {scale.unit}", y_title=f"error, {scale.fine}")


def drawings(scale: Scale = LENGTHS) -> tuple[Drawing, ...]:
    """Return the figures of one run."""
    return (Drawing("along", "Error of the run along its path", 520, partial(_along, scale=scale)),)


DRAWINGS = drawings()
