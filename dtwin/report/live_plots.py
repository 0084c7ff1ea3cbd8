"""Figures of a serving session that is running."""

from __future__ import annotations

import numpy as np
import plotly.graph_objects as go

from dtwin.report.plots import COLOURS, styled
from dtwin.schema import Floats
from dtwin.units import UM_PER_MM

_MOST_DRAWN = 1500
_WHOLE_TURN_RAD = 1.9 * np.pi
_BINS = 180


def correction_figure(t_s: Floats, correction_um: Floats, clamp_um: float) -> go.Figure:
    """Return the corrections of the newest ticks with their limit.

    Parameters
    ----------
    t_s : ndarray, shape (n,)
        Time before the newest tick, zero or negative.
    correction_um : ndarray, shape (n, 3)
        What was sent, along the axes of the robot's base.
    clamp_um : float
        Longest correction that is allowed.
    """
    step = max(1, len(t_s) // _MOST_DRAWN)
    figure = go.Figure()
    for column, (name, colour) in enumerate(
        (("X", COLOURS["measured"]), ("Y", COLOURS["second"]), ("Z", COLOURS["third"]))
    ):
        figure.add_trace(
            go.Scatter(
                x=t_s[::step].round(3).tolist(),
                y=correction_um[::step, column].round(3).tolist(),
                name=name,
                mode="lines",
                line={"color": colour, "dash": ("solid", "dot", "dash")[column]},
            )
        )
    for limit in (-clamp_um, clamp_um):
        figure.add_hline(y=limit, line={"color": COLOURS["floor"], "dash": "dash"})
    figure.update_layout(
        title="Correction of each axis; dashed: its limit",
        xaxis_title="s before now",
        yaxis_title="um",
    )
    return styled(figure)


def circle_figure(
    position_mm: Floats, centre_mm: Floats, radius_mm: float, correction_um: Floats
) -> go.Figure | None:
    """Return the newest circle as the controller sees it, with what the correction adds.

    Without the correction the path would have been shorter or longer by the radial part of the
    correction: that is drawn as the uncompensated circle. What the controller cannot see, as a
    ball bar would, is in neither of the two.

    Parameters
    ----------
    position_mm : ndarray, shape (n, 3)
        Actual tool positions of one segment, oldest first.
    centre_mm : ndarray, shape (3,)
        Centre of the circle.
    radius_mm : float
        Its radius.
    correction_um : ndarray, shape (n, 3)
        Corrections that were sent.

    Returns
    -------
    Figure or None
        None when it is no circle, or not yet a turn.
    """
    arm = position_mm - centre_mm
    if radius_mm <= 0.0 or len(arm) < _BINS:
        return None
    first, second = sorted(np.argsort(-arm.var(axis=0))[:2])
    if (int(first), int(second)) == (0, 2):
        # ZX turns from Z towards X.
        first, second = second, first
    angle = np.unwrap(np.arctan2(arm[:, second], arm[:, first]))
    newest = np.abs(angle - angle[-1]) <= 2.0 * np.pi
    if abs(angle[-1] - angle[newest][0]) < _WHOLE_TURN_RAD:
        return None
    arm, angle, sent = arm[newest], angle[newest], correction_um[newest]
    length = np.linalg.norm(arm, axis=1)
    seen_um = (length - radius_mm) * UM_PER_MM
    radial_um = (sent * arm).sum(axis=1) / length
    bins = (np.degrees(angle) // (360 / _BINS)).astype(int) % _BINS
    count = np.bincount(bins, minlength=_BINS)
    middle = (np.arange(_BINS) + 0.5) * 360.0 / _BINS
    figure = go.Figure()
    for name, values, colour, dash in (
        ("with the correction", seen_um, COLOURS["second"], "solid"),
        ("without it", seen_um - radial_um, COLOURS["measured"], "dot"),
    ):
        mean = np.bincount(bins, values, _BINS)[count > 0] / count[count > 0]
        figure.add_trace(
            go.Scatter(
                x=middle[count > 0].tolist(),
                y=mean.round(3).tolist(),
                name=name,
                mode="lines",
                line={"color": colour, "dash": dash},
            )
        )
    figure.update_layout(
        title=f"The newest circle of R{radius_mm:g} as the controller's own encoders see it",
        xaxis_title=f"angle in the {'XYZ'[first]}{'XYZ'[second]} plane, degrees",
        yaxis_title="radial deviation, um",
    )
    return styled(figure)


def waiting_figure(words: str) -> go.Figure:
    """Return an empty figure that says what it waits for."""
    figure = go.Figure()
    figure.update_layout(title=words, xaxis={"visible": False}, yaxis={"visible": False})
    return styled(figure)
