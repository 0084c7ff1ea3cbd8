"""Figures of one run of a circle."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from dtwin.kinds.kind import Drawing
from dtwin.physics.circular import fit_circle, residual_um
from dtwin.report.plots import error_figure, lacks_columns, polar_figure, spectrum_figure
from dtwin.schema import Floats, Run

if TYPE_CHECKING:
    import plotly.graph_objects as go

_NOISE_QUANTILE = 3.0


def _polar(run: Run, floor_um: Callable[[], float]) -> go.Figure:
    radius = float(run.meta.radius_mm or 100.0)
    curves = {run.meta.run_id: _centred(run)}
    return polar_figure(curves, radius, title=_title(run), floor_um=floor_um(), plane=run.meta.plane)


def _over_angle(run: Run, floor_um: Callable[[], float]) -> go.Figure:
    angle, left_um = _centred(run)
    # A clockwise run falls from 0: as every other picture, it is drawn over 0 to 360 degrees.
    turns = np.ceil(max(-float(angle.min(initial=0.0)) - 1.0, 0.0) / 360.0)
    curves = {run.meta.run_id: (angle + 360.0 * turns, left_um)}
    return error_figure(curves, title=_title(run), floor_um=floor_um())


def _over_time(run: Run, floor_um: Callable[[], float]) -> go.Figure:
    _, left_um = _centred(run)
    t_s = np.asarray(run.samples["t_s"], float)[run.marked]
    curves = {run.meta.run_id: (t_s, left_um)}
    return error_figure(curves, title=_title(run), floor_um=floor_um(), x_title="time, s")


def _spectrum(run: Run, floor_um: Callable[[], float]) -> go.Figure:
    _, left_um = _centred(run)
    n = left_um.size
    window = np.hanning(n)
    amplitude = 2.0 * np.abs(np.fft.rfft((left_um - left_um.mean()) * window)) / window.sum()
    # Lines of noise alone are Rayleigh distributed; the median is not moved by a few true lines.
    upper = amplitude[n // 4 :]
    noise = _NOISE_QUANTILE * float(np.median(upper)) / float(np.sqrt(np.log(4.0)))
    return spectrum_figure(
        np.asarray(np.fft.rfftfreq(n, 1.0 / run.meta.sample_rate_hz), dtype=np.float64),
        amplitude,
        noise,
        title=f"{run.meta.run_id}: spectrum of one run (its upper half gives the noise; one run has no repeats)",
    )


def _title(run: Run) -> str:
    return f"{run.meta.run_id}: error after centre and radius"


def _centred(run: Run) -> tuple[Floats, Floats]:
    if not {"angle_deg", "deviation_um"} <= set(run.samples):
        raise lacks_columns(run, "deviation over an angle", "angle_deg, deviation_um")
    angle = np.asarray(run.samples["angle_deg"], float)[run.marked]
    deviation = np.asarray(run.samples["deviation_um"], float)[run.marked]
    radius = float(run.meta.radius_mm or 100.0)
    return angle, residual_um(angle, deviation, radius, fit_circle(angle, deviation, radius))


DRAWINGS = (
    Drawing(
        "polar",
        "Polar plot of the run",
        560,
        _polar,
        half=True,
        note="A grey band, where conditions were repeated, is the noise floor of the campaign (unit of "
        "replication: the run). It is of values averaged over one degree; the curves are the samples "
        "themselves.",
    ),
    Drawing("angle", "Error over the path angle", 460, _over_angle, half=True),
    Drawing("time", "Error over time", 380, _over_time),
    Drawing("spectrum", "Amplitude spectrum of the run", 420, _spectrum),
)
