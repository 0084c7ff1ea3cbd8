"""Test sheet of drift after ISO 230-3: how far a place moves, and how far a machine at rest does."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from dtwin.kinds.drift._model import Series, Term
from dtwin.kinds.drift._series import moved_um, series_of
from dtwin.kinds.kind import Drawing
from dtwin.report.plots import error_figure, lacks_columns
from dtwin.report.sheet import Characteristic, Part, Sheet, sound_runs
from dtwin.report.uncertainty import Circumstances, Variation
from dtwin.schema import Floats, Run
from dtwin.statistics import rms, times_simulated

if TYPE_CHECKING:
    import plotly.graph_objects as go

_READING_UM = 0.5
# A median of neighbours that share readings tells a fifth of what as many readings at rest would.
_OF_NEXT = 0.2
_HOUR_S = 3600.0
_NO_EXTREME = 10.0
_AT_REST = "environment"
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
        hours = _hours(t_s)
        of_mean = series.floor_um / math.sqrt(len(series.t_s) / len(t_s))
        dof = float(len(series.t_s) - len(t_s))
        if not math.isfinite(of_mean):
            of_mean, dof = series.next_um, 0.0
            if math.isfinite(of_mean):
                dof = _OF_NEXT * len(series.t_s)
                notes.append(
                    f"{run.meta.run_id}: no sample was read twice; U takes what readings that follow each other scatter by."
                )
        rows = [("d", "range of the drift", moved)]
        if hours:
            worst = max(hours, key=lambda hour: np.ptp(moved[hour]))
            rows.append(("d(1 h)", "range in one hour", moved[worst]))
        else:
            notes.append(f"{run.meta.run_id}: no hour holds two readings, so the range in one hour is not known.")
        figures = tuple(
            Characteristic(
                symbol,
                name,
                float(np.ptp(of)),
                1,
                _scatter_um(of, of_mean),
                dof,
                contributions=under.probe(_READING_UM, float(np.ptp(of))),
            )
            for symbol, name, of in rows
        )
        title = f"{run.meta.run_id}, {(t_s[-1] - t_s[0]) / _HOUR_S:z.1f} h"
        parts.append(Part(title, (run.meta.run_id,), figures, sound))
    basis = "what readings of one sample differ by (unit of replication: the reading)"
    return Sheet("ISO 230-3, thermal drift", "d", tuple(parts), basis, tuple(notes))


def variation(runs: Sequence[Run], campaign: str) -> Variation | None:
    """Return the mean range within one hour of the logs of a machine at rest, the largest of several logs."""
    variations = []
    for run in runs:
        sound = not any(f.severity == "error" for f in run.findings)
        if sound and run.meta.condition.get("test") == _AT_REST and len(run.samples["t_s"]) > 1:
            t_s, moved = _means(series_of(run, as_read=True))
            hours = min(1.0, float(t_s[-1] - t_s[0]) / _HOUR_S)
            ranges = [np.ptp(moved[hour]) for hour in _hours(t_s)]
            variations += [Variation(float(np.mean(ranges)), round(hours, 2), campaign)] if ranges else []
    return max(variations, key=lambda one: one.range_um, default=None)


def drift_figure(runs: Sequence[Run]) -> go.Figure:
    """Draw the displacement over the time."""
    curves = {run.meta.run_id: (run.samples["t_s"] / _HOUR_S, moved_um(run)) for run in runs}
    return error_figure(curves, title="Displacement", x_title="time, h", y_title="displacement, µm")


def _over_time(run: Run, floor_um: Callable[[], float]) -> go.Figure:
    """Draw the displacement over the time, and below it the temperatures."""
    if not {"t_s", "displacement_um"} <= set(run.samples):
        raise lacks_columns(run, "displacement over the time", "t_s, displacement_um")
    figure = drift_figure([run]).update_traces(name="displacement")
    hours = run.samples["t_s"] / _HOUR_S
    for name, values in run.samples.items():
        if name.startswith("temperature_"):
            figure.add_scatter(x=hours, y=values, name=Term("steady", name).name, yaxis="y2", line_width=1.5)
    if len(figure.data) > 1:
        figure.update_layout(yaxis_domain=[0.55, 1.0], yaxis2={"domain": [0.0, 0.45], "title": "temperature, °C"})
        figure.update_layout(xaxis_anchor="y2", showlegend=True, height=620)
    return figure


DRAWINGS = (Drawing("time", "Displacement and temperatures over the time", 620, _over_time),)


def _means(series: Series) -> tuple[Floats, Floats]:
    """Return time and displacement of each sample, readings of one sample taken together."""
    if series.sample is None:
        return series.t_s, series.moved_um
    label = np.unique(series.sample, return_inverse=True)[1]
    count = np.bincount(label)
    t_s, moved = np.bincount(label, series.t_s) / count, np.bincount(label, series.moved_um) / count
    order = np.argsort(t_s, kind="stable")
    return t_s[order], moved[order]


def _scatter_um(moved: Floats, of_mean: float) -> float:
    """Return the standard deviation of the range of means (samples,) that scatter by ``of_mean``; NaN where that is not known."""
    if not math.isfinite(of_mean):
        return math.nan
    # About readings as they are, the highest would stand out twice: by its own scatter, and by what is drawn.
    calm = _smooth(moved, of_mean)
    far = _NO_EXTREME * of_mean
    near = calm[(calm >= calm.max() - far) | (calm <= calm.min() + far)]
    drawn = np.random.default_rng(0).standard_normal((times_simulated(near.size), near.size))
    return float(np.std(np.ptp(near + of_mean * drawn, axis=1), ddof=1))


def _smooth(moved: Floats, of_mean: float) -> Floats:
    """Return the widest moving average that is as near to the readings as they scatter; themselves where none is."""
    calm, half = moved, 1
    while 2 * half < moved.size:
        # Sums up to each reading: a log of a day has many, and half of them may be averaged.
        sums = np.cumsum(np.pad(moved - moved[0], (half + 1, half), mode="reflect", reflect_type="odd"))
        wider = moved[0] + (sums[2 * half + 1 :] - sums[: -2 * half - 1]) / (2 * half + 1)
        if rms(moved - wider) > of_mean:
            break
        calm, half = wider, 2 * half
    return calm


def _hours(t_s: Floats) -> list[slice]:
    """Return the hour from every reading on that has a whole hour after it, and a second reading in it; of a short log, all of it."""
    if t_s[0] + _HOUR_S > t_s[-1]:
        return [slice(None)]
    last = np.searchsorted(t_s, t_s + _HOUR_S, side="right")
    whole = np.flatnonzero(t_s + _HOUR_S <= t_s[-1]).tolist()
    return [slice(n, int(last[n])) for n in whole if last[n] > n + 1]
