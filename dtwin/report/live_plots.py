"""Figures of a serving session that is running."""

from __future__ import annotations

import numpy as np
import plotly.graph_objects as go

from dtwin.report.plots import COLOURS, draw_line, styled
from dtwin.schema import Floats
from dtwin.units import UM_PER_MM

_MOST_DRAWN = 1500
_WHOLE_TURN_RAD = 1.9 * np.pi
_BINS = 180
# Off the circle by more than this share of the radius is no circle.
_NEAR = 0.01


def correction_figure(t_s: Floats, correction_um: Floats, clamp_um: float, band_um: Floats) -> go.Figure:
    """Return the corrections of the newest ticks with their limit and their uncertainty.

    ``t_s``, shape (n,): time before the newest tick, zero or negative.
    ``correction_um``, shape (n, 3): what was sent, along the axes of the robot's base.
    ``clamp_um``: longest correction that is allowed.
    ``band_um``, shape (n, 3): half width (k = 2) of what the model asked for; NaN where it does not tell.
    """
    step = max(1, len(t_s) // _MOST_DRAWN)
    figure = go.Figure()
    known = bool(np.isfinite(band_um).any())
    for column, (name, colour) in enumerate(
        (("X", COLOURS["measured"]), ("Y", COLOURS["second"]), ("Z", COLOURS["third"]))
    ):
        if known:
            figure.add_trace(_strip(t_s[::step], correction_um[::step, column], band_um[::step, column], name, colour))
        x, y = (values[::step].round(3).tolist() for values in (t_s, correction_um[:, column]))
        draw_line(figure, x, y, name, color=colour, dash=("solid", "dot", "dash")[column])
    for limit in (-clamp_um, clamp_um):
        figure.add_hline(y=limit, line={"color": COLOURS["floor"], "dash": "dash"})
    told = "shaded: its uncertainty, k = 2" if known else "the model does not tell its uncertainty"
    figure.update_layout(
        title=f"Correction of each axis; dashed: its limit; {told}",
        xaxis_title="s before the newest tick",
        yaxis_title="µm",
    )
    return styled(figure)


def _strip(t_s: Floats, correction_um: Floats, band_um: Floats, name: str, colour: str) -> go.Scatter:
    """Return the area between correction minus and plus its half width; none where that is not known."""
    half = np.nan_to_num(band_um)
    around = np.concatenate([correction_um + half, (correction_um - half)[::-1]])
    return go.Scatter(
        x=np.concatenate([t_s, t_s[::-1]]).round(3).tolist(),
        y=around.round(3).tolist(),
        name=f"{name} ± U",
        fill="toself",
        mode="lines",
        line={"width": 0, "color": colour},
        opacity=0.3,
        hoverinfo="skip",
        showlegend=False,
    )


def circle_figure(position_mm: Floats, centre_mm: Floats, radius_mm: Floats, correction_um: Floats) -> go.Figure | None:
    """Return the newest whole circle as the controller sees it, with and without the correction.

    The radial part of the correction is what it added to the path: without it, that much would
    be missing. What the controller cannot see, as a ball bar would, is in neither of the two.

    ``position_mm``, shape (n, 3): actual tool positions, oldest first.
    ``centre_mm``, shape (n, 3): centre of the circle that is run; any value beside one.
    ``radius_mm``, shape (n,): its radius; 0 beside one.
    ``correction_um``, shape (n, 3): corrections that were sent.
    Returns none when no whole turn is in it.
    """
    arm = position_mm - centre_mm
    length = np.linalg.norm(arm, axis=1)
    step = np.linalg.norm(np.diff(arm, axis=0, prepend=arm[:1]), axis=1)
    outward = np.abs(np.diff(length, prepend=length[:1]))
    near = np.abs(length - radius_mm) < _NEAR * radius_mm
    # Ways to the circle and from it go outward, stops go nowhere.
    around = np.flatnonzero(near & (step > 3.0 * outward))
    here = np.column_stack([centre_mm, radius_mm])[around]
    ends = np.flatnonzero((np.diff(here, axis=0) != 0.0).any(axis=1)) + 1
    for rows in np.split(around, ends)[::-1]:
        if len(rows) > _BINS:
            radial_um = (correction_um[rows] * arm[rows]).sum(axis=1) / length[rows]
            seen_um = (length[rows] - radius_mm[rows]) * UM_PER_MM
            figure = _turn_figure(arm[rows], float(radius_mm[rows[-1]]), seen_um, radial_um)
            if figure is not None:
                return figure
    return None


def _turn_figure(arm_mm: Floats, radius_mm: float, seen_um: Floats, radial_um: Floats) -> go.Figure | None:
    """Return the newest turn of a stretch on the circle; None when it is shorter."""
    first, second = (int(i) for i in sorted(np.argsort(-arm_mm.var(axis=0))[:2]))
    if (first, second) == (0, 2):
        # ZX turns from Z towards X.
        first, second = second, first
    angle = np.unwrap(np.arctan2(arm_mm[:, second], arm_mm[:, first]))
    # The other sense is another circle.
    turned = np.flatnonzero(np.diff(np.sign(np.diff(angle)))) + 1
    for sense in np.split(np.arange(len(angle)), turned)[::-1]:
        newest = sense[np.abs(angle[sense] - angle[sense[-1]]) <= 2.0 * np.pi]
        if np.ptp(angle[newest]) >= _WHOLE_TURN_RAD:
            break
    else:
        return None
    bins = (np.degrees(angle[newest]) // (360 / _BINS)).astype(int) % _BINS
    count = np.bincount(bins, minlength=_BINS)
    known = count > 0
    middle = (np.arange(_BINS) + 0.5) * 360.0 / _BINS
    figure = go.Figure()
    for name, values, colour, dash in (
        ("with the correction", seen_um, COLOURS["second"], "solid"),
        ("without it", seen_um - radial_um, COLOURS["measured"], "dot"),
    ):
        mean = np.bincount(bins, values[newest], _BINS)[known] / count[known]
        draw_line(figure, middle[known].tolist(), mean.round(3).tolist(), name, color=colour, dash=dash)
    figure.update_layout(
        title=f"The newest circle of R{radius_mm:g} as the controller's own encoders see it",
        xaxis_title=f"angle in the {'XYZ'[first]}{'XYZ'[second]} plane, degrees",
        yaxis_title="radial deviation, µm",
    )
    return styled(figure)


def waiting_figure(words: str) -> go.Figure:
    """Return an empty figure that says what it waits for."""
    figure = go.Figure()
    figure.update_layout(title=words, xaxis={"visible": False}, yaxis={"visible": False})
    return styled(figure)
