"""Figures for reports, the registry and the browser; the same functions serve all of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go

from dtwin.schema import Floats

# Okabe and Ito: told apart by every kind of colour vision.
COLOURS = {
    "measured": "#0072B2",
    "second": "#D55E00",
    "third": "#009E73",
    "fourth": "#CC79A7",
    "floor": "#999999",
}
_LOWEST_R2 = -0.5
_FAR = 100.0
_PALETTE = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9"]


def polar_figure(
    traces: Mapping[str, tuple[Floats, Floats]],
    radius_mm: float,
    *,
    title: str,
    magnification: float | None = None,
) -> go.Figure:
    """Return a polar plot as ball-bar people draw it: error magnified about the nominal circle.

    Parameters
    ----------
    traces : mapping of str to (angle_deg, deviation_um)
        Curves by name, arrays of shape (n,).
    radius_mm : float
        Nominal radius.
    title : str
        Heading.
    magnification : float, optional
        Drawn millimetres per millimetre of error; chosen from the largest error when left out.
    """
    largest = max((float(np.max(np.abs(d))) for _, d in traces.values()), default=1.0)
    factor = magnification or magnification_for(largest, radius_mm)
    figure = go.Figure()
    circle = np.linspace(0.0, 360.0, 181)
    figure.add_trace(
        go.Scatterpolar(
            theta=circle,
            r=np.full(circle.size, radius_mm),
            mode="lines",
            name="nominal",
            line={"color": COLOURS["floor"], "width": 1, "dash": "dot"},
            hoverinfo="skip",
        )
    )
    for colour, (name, (angle, deviation)) in zip(_PALETTE * 4, traces.items(), strict=False):
        figure.add_trace(
            go.Scatterpolar(
                theta=_short(angle),
                r=_short(radius_mm + deviation * factor / 1000.0),
                mode="lines",
                name=name,
                line={"color": colour, "width": 1.5},
                customdata=_short(deviation),
                hovertemplate="%{theta:.1f} deg<br>%{customdata:.1f} um<extra>" + name + "</extra>",
            )
        )
    figure.update_layout(
        title=f"{title} ({factor:g} x)",
        polar={
            "radialaxis": {"range": [0.0, 1.4 * radius_mm], "showticklabels": False, "ticks": ""},
            "angularaxis": {"rotation": 0, "direction": "counterclockwise"},
        },
    )
    return styled(figure)


def error_figure(traces: Mapping[str, tuple[Floats, Floats]], *, title: str) -> go.Figure:
    """Return error over the path angle.

    Parameters
    ----------
    traces : mapping of str to (angle_deg, error_um)
        Curves by name.
    title : str
        Heading.
    """
    figure = go.Figure()
    for colour, (name, (angle, error)) in zip(_PALETTE * 4, traces.items(), strict=False):
        figure.add_trace(
            go.Scatter(
                x=_short(angle),
                y=_short(error),
                mode="lines",
                name=name,
                line={"color": colour, "width": 1.5},
            )
        )
    figure.update_layout(title=title, xaxis_title="path angle, deg", yaxis_title="error, um")
    return styled(figure)


def evidence_figure(evidence: Mapping[str, Any]) -> go.Figure:
    """Return error before and after per condition, with the oracle and the noise floor.

    Parameters
    ----------
    evidence : mapping
        As ``Evidence.as_dict`` gives it.
    """
    conditions = evidence["conditions"]
    names = [
        f"{c['plane']} R{c['radius_mm']:g} F{c['feed_mm_min']:g}{'' if c['trained'] else ' *'}"
        for c in conditions
    ]
    figure = go.Figure()
    for name, key, colour in (
        ("uncompensated", "before", COLOURS["measured"]),
        ("compensated", "after", COLOURS["second"]),
    ):
        figure.add_trace(
            go.Bar(
                x=names,
                y=[c[f"{key}_um"] for c in conditions],
                name=name,
                marker_color=colour,
                error_y={"type": "data", "array": [c[f"{key}_ci_um"] for c in conditions]},
            )
        )
    figure.add_trace(
        go.Scatter(
            x=names,
            y=[c["oracle_um"] for c in conditions],
            name="oracle",
            mode="markers",
            marker={
                "symbol": "line-ew-open",
                "size": 22,
                "color": COLOURS["third"],
                "line": {"width": 3},
            },
        )
    )
    figure.add_trace(
        go.Scatter(
            x=names,
            y=[c["floor_um"] for c in conditions],
            name="noise floor",
            mode="lines",
            line={"color": COLOURS["floor"], "dash": "dash"},
        )
    )
    figure.update_layout(
        title="Radial error, RMS after set-up; bars: 95 % over runs; *: feed not trained",
        yaxis_title="um",
        barmode="group",
    )
    return styled(figure)


def comparison_figure(candidates: Sequence[Mapping[str, Any]], floor_um: float) -> go.Figure:
    """Return held-out error against latency, one point per candidate.

    Parameters
    ----------
    candidates : sequence of mapping
        With ``name``, ``rms_um``, ``p50_us`` (may be None) and ``promotable``.
    floor_um : float
        Noise floor.
    """
    figure = go.Figure()
    for promotable, colour in ((True, COLOURS["second"]), (False, COLOURS["measured"])):
        chosen = [c for c in candidates if c["promotable"] == promotable and c["p50_us"]]
        figure.add_trace(
            go.Scatter(
                x=[c["p50_us"] for c in chosen],
                y=[c["rms_um"] for c in chosen],
                text=[c["name"] for c in chosen],
                mode="markers+text" if promotable else "markers",
                textposition="top right",
                hovertemplate="%{text}<br>%{x:.3g} us, %{y:.1f} um<extra></extra>",
                name="expression, promotable" if promotable else "comparison only",
                marker={
                    "size": 12,
                    "color": colour,
                    "symbol": "circle" if promotable else "square",
                },
            )
        )
    figure.add_hline(
        y=floor_um, line_dash="dash", line_color=COLOURS["floor"], annotation_text="noise floor"
    )
    figure.update_layout(
        title="Error on feeds left out against time of one row (hover for names)",
        xaxis={"title": "median time of one row, us", "type": "log"},
        yaxis={"title": "held-out RMS, um", **_range_of([c["rms_um"] for c in candidates])},
    )
    return styled(figure)


def r2_figure(candidates: Sequence[Mapping[str, Any]]) -> go.Figure:
    """Return R2 on feeds left out against latency, one point per candidate.

    Parameters
    ----------
    candidates : sequence of mapping
        With ``name``, ``r2``, ``p50_us`` (may be None) and ``promotable``.
    """
    figure = go.Figure()
    for promotable, colour in ((True, COLOURS["second"]), (False, COLOURS["measured"])):
        chosen = [c for c in candidates if c["promotable"] == promotable and c["p50_us"]]
        figure.add_trace(
            go.Scatter(
                x=[c["p50_us"] for c in chosen], y=[max(c["r2"], _LOWEST_R2) for c in chosen],
                customdata=[c["r2"] for c in chosen],
                text=[c["name"] for c in chosen], mode="markers",
                hovertemplate="%{text}<br>%{x:.3g} us, R2 %{customdata:.3g}<extra></extra>",
                name="expression, promotable" if promotable else "comparison only",
                marker={
                    "size": 12, "color": colour, "symbol": "circle" if promotable else "square"
                },
            )
        )  # fmt: skip
    figure.add_hline(
        y=0.0, line_dash="dash", line_color=COLOURS["floor"], annotation_text="no correction"
    )
    figure.update_layout(
        title=f"R2 on feeds left out against time of one row (below {_LOWEST_R2:g}: at the edge)",
        xaxis={"title": "median time of one row, us", "type": "log"},
        yaxis={"title": "R2, held out"},
    )
    return styled(figure)


def front_figure(front: Sequence[Mapping[str, Any]], floor_um: float) -> go.Figure:
    """Return held-out error over the size of the equation.

    Parameters
    ----------
    front : sequence of mapping
        With ``terms``, ``held_out_rms_um`` and ``radius_out_rms_um``.
    floor_um : float
        Noise floor.
    """
    figure = go.Figure()
    terms = [point["terms"] for point in front]
    for name, key, colour in (
        ("feeds left out", "held_out_rms_um", COLOURS["measured"]),
        ("radii left out", "radius_out_rms_um", COLOURS["second"]),
    ):
        figure.add_trace(
            go.Scatter(
                x=terms,
                y=[point[key] for point in front],
                mode="lines+markers",
                name=name,
                line={"color": colour},
            )
        )
    figure.add_hline(
        y=floor_um, line_dash="dash", line_color=COLOURS["floor"], annotation_text="noise floor"
    )
    figure.update_layout(
        title="Accuracy and complexity of the physics library",
        xaxis_title="terms",
        yaxis={"title": "RMS, um", "rangemode": "tozero"},
    )
    return styled(figure)


def spectrum_figure(
    frequency_hz: Floats, amplitude_um: Floats, floor_um: float, *, title: str
) -> go.Figure:
    """Return the amplitude spectrum of a run.

    Parameters
    ----------
    frequency_hz, amplitude_um : ndarray, shape (n,)
        The spectrum.
    floor_um : float
        Level that noise alone rarely exceeds; NaN when it is not known.
    title : str
        Heading.
    """
    figure = go.Figure(
        go.Scatter(
            x=_short(frequency_hz), y=_short(amplitude_um), mode="lines", name="amplitude",
            line={"color": COLOURS["measured"], "width": 1.3},
            hovertemplate="%{x:.2f} Hz: %{y:.3f} um<extra></extra>",
        )
    )  # fmt: skip
    if np.isfinite(floor_um):
        figure.add_hline(
            y=floor_um, line={"color": COLOURS["floor"], "dash": "dash"},
            annotation_text=f"noise of one line {floor_um:.3f} um",
        )  # fmt: skip
    figure.update_layout(
        title=title, xaxis_title="frequency, Hz",
        yaxis={"title": "amplitude, um", "rangemode": "tozero"},
    )  # fmt: skip
    return styled(figure)


def _range_of(values: Sequence[float]) -> dict[str, str]:
    """Return a logarithmic axis where one value would flatten all others."""
    far = max(values, default=0.0) > _FAR * min(values, default=0.0)
    return {"type": "log"} if far else {"rangemode": "tozero"}


def jitter_figure(histogram: Mapping[str, int]) -> go.Figure:
    """Return how far the periods of a serving session were off.

    Parameters
    ----------
    histogram : dict of str to int
        Ticks by jitter in us, as ``LoopTiming.summary`` counts them.
    """
    top = float(np.ceil(np.log10(max([*histogram.values(), 10]))))
    figure = go.Figure(
        go.Bar(x=list(histogram), y=list(histogram.values()), marker_color=COLOURS["measured"])
    )
    figure.update_layout(
        title="Jitter of the period",
        xaxis_title="distance from the nominal period, us",
        yaxis={"title": "ticks (logarithmic)", "type": "log", "dtick": 1, "range": [-0.3, top]},
    )
    return styled(figure)


def magnification_for(largest_um: float, radius_mm: float) -> float:
    """Return the round magnification that draws an error as about a third of the radius.

    Parameters
    ----------
    largest_um : float
        Largest error that is to be drawn.
    radius_mm : float
        Nominal radius.
    """
    return _round_factor(0.35 * radius_mm * 1000.0 / max(largest_um, 1e-9))


def styled(figure: go.Figure) -> go.Figure:
    """Give a figure the look of all dtwin's figures; a height that was chosen stays."""
    figure.update_layout(
        template="plotly_white",
        height=figure.layout.height or 460,
        title_font_size=15,
        margin={"l": 60, "r": 30, "t": 95, "b": 60},
        font={"family": "system-ui, sans-serif", "size": 13},
        legend={"orientation": "h", "y": 1.0, "yanchor": "bottom"},
    )
    return figure


def _short(values: Floats) -> list[float]:
    """Thin a long curve and round it: a report is looked at, not computed with."""
    step = max(1, len(values) // 1500)
    return [round(float(v), 4) for v in np.asarray(values)[::step]]


def _round_factor(value: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is not above a value."""
    power = 10.0 ** np.floor(np.log10(max(value, 1e-9)))
    return float(max(m * power for m in (1.0, 2.0, 5.0) if m * power <= value * (1 + 1e-9)))
