"""Pictures of a cycle of a ball array."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import plotly.graph_objects as go

from dtwin.kinds.kind import Drawing
from dtwin.report.plots import lacks_columns, places_figure
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
