"""Test sheet of drift after ISO 230-3: how far a place moves, and how far a machine at rest does."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from dtwin.kinds.drift._model import Series, series_of
from dtwin.kinds.drift._sense import moved_um
from dtwin.report.plots import error_figure
from dtwin.report.sheet import Characteristic, Part, Sheet, sound_runs
from dtwin.report.uncertainty import Circumstances, Variation
from dtwin.schema import Floats, Run

if TYPE_CHECKING:
    import plotly.graph_objects as go

_READING_UM = 0.5
_HOUR_S = 3600.0
AT_REST = "environment"
"""What a run states as its ``test`` when nothing heated the machine but its surroundings."""


def drift_sheet(runs: Sequence[Run], under: Circumstances) -> Sheet:
    """Evaluate every log: the range of the displacement, of the whole and in the worst hour."""
    parts, notes = [], []
    for run in runs:
        if len(run.samples["t_s"]) < 2:
            notes.append(f"{run.meta.run_id} is not evaluated: it has fewer than two readings.")
            continue
        notes += sound_runs([run])[1]
        sound = not any(f.severity == "error" for f in run.findings)
        series = series_of(run, as_read=True)
        t_s, moved = _means(series)
        spans = _ranges_um(t_s, moved)
        each = len(series.t_s) / len(t_s)
        # A range is a difference of two means.
        scatter = series.floor_um * math.sqrt(2.0 / each)
        dof = float(len(series.t_s) - len(t_s)) if math.isfinite(scatter) else 0.0
        found = (("d", "range of the drift", float(np.ptp(moved))), ("d(1 h)", "range in one hour", float(spans.max())))
        figures = tuple(
            Characteristic(symbol, name, value, 1, scatter, dof, contributions=(under.reading(_READING_UM),))
            for symbol, name, value in found
        )
        title = f"{run.meta.run_id}, {(t_s[-1] - t_s[0]) / _HOUR_S:z.1f} h"
        parts.append(Part(title, (run.meta.run_id,), figures, sound))
    basis = "what readings of one sample differ by (unit of replication: the reading)"
    return Sheet("ISO 230-3, thermal drift", "d", tuple(parts), basis, tuple(notes))


def variation(runs: Sequence[Run], campaign: str) -> Variation | None:
    """Return the mean range within one hour of the logs of a machine at rest, the largest of several logs."""
    found = []
    for run in runs:
        sound = not any(f.severity == "error" for f in run.findings)
        if sound and run.meta.condition.get("test") == AT_REST and len(run.samples["t_s"]) > 1:
            t_s, moved = _means(series_of(run, as_read=True))
            hours = min(1.0, float(t_s[-1] - t_s[0]) / _HOUR_S)
            found.append(Variation(float(_ranges_um(t_s, moved).mean()), round(hours, 2), campaign))
    return max(found, key=lambda one: one.range_um, default=None)


def drift_figure(runs: Sequence[Run]) -> go.Figure:
    """Draw the displacement over the time."""
    curves = {run.meta.run_id: (run.samples["t_s"] / _HOUR_S, moved_um(run)) for run in runs}
    return error_figure(curves, title="Displacement", x_title="time, h", y_title="displacement, µm")


def _means(series: Series) -> tuple[Floats, Floats]:
    """Return time and displacement of each sample, readings of one sample taken together."""
    if series.sample is None:
        return series.t_s, series.moved_um
    label = np.unique(series.sample, return_inverse=True)[1]
    count = np.bincount(label)
    t_s, moved = np.bincount(label, series.t_s) / count, np.bincount(label, series.moved_um) / count
    order = np.argsort(t_s, kind="stable")
    return t_s[order], moved[order]


def _ranges_um(t_s: Floats, moved: Floats) -> Floats:
    """Return the range within one hour from every reading on that has a whole hour after it; of a short log, its own."""
    last = np.searchsorted(t_s, t_s + _HOUR_S, side="right")
    whole = np.flatnonzero(t_s + _HOUR_S <= t_s[-1])
    if not whole.size:
        return np.array([np.ptp(moved)])
    return np.array([np.ptp(moved[n : last[n]]) for n in whole])
