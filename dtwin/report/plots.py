"""Figures for reports, the registry and the browser; the same functions serve all of them.

``floor_um`` is a noise floor: None draws nothing, NaN says in the figure that it is not known.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import plotly.graph_objects as go
import plotly.io as pio

from dtwin.errors import InputError
from dtwin.schema import Floats, Run

# Okabe and Ito: told apart by every kind of colour vision.
COLOURS = {"measured": "#0072B2", "second": "#D55E00", "third": "#009E73", "fourth": "#CC79A7", "floor": "#999999"}
BEHIND_TEXT = "rgba(255,255,255,0.75)"
_REACH = 0.4
"""Part of the radius that the largest error may take in a polar plot."""
_ARROW_DEG = 8.0
_PALETTE = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9"]


def lacks_columns(run: Run, what: str, allowed: str) -> InputError:
    """Return the refusal to draw a run without the columns of a figure."""
    return InputError(
        f"the run has no {what}", code="run.columns", where=run.meta.run_id, got=", ".join(run.samples), allowed=allowed
    )


def polar_figure(
    traces: Mapping[str, tuple[Floats, Floats]],
    radius_mm: float,
    *,
    title: str,
    magnification: float | None = None,
    floor_um: float | None = None,
    plane: str | None = None,
) -> go.Figure:
    """Return a polar plot as ball-bar people draw it: error magnified about the nominal circle.

    Args:
        traces: Curves by name, arrays of shape (n,).
        magnification: Drawn millimetres per millimetre of error; chosen from the largest error when left out.
        plane: Two axes, the first of which lies at 0 degrees.
    """
    largest = max((float(np.max(np.abs(d))) for _, d in traces.values()), default=1.0)
    factor = magnification or magnification_for(largest, radius_mm)
    figure = go.Figure()
    circle = np.linspace(0.0, 360.0, 181)
    for name, error_um, look in floor_rings(floor_um):
        ring = np.full(circle.size, radius_mm + error_um * factor / 1000.0)
        figure.add_trace(go.Scatterpolar(theta=circle, r=ring, mode="lines", name=name, **look))
    if floor_um is not None and not np.isfinite(floor_um):
        say_no_floor(figure)
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
                hovertemplate="%{theta:z.1f}°<br>%{customdata:z.1f} µm<extra>" + name + "</extra>",
            )
        )
        # Above its own line, which hides it where the run is noisy.
        figure.add_trace(_start(angle, radius_mm + deviation * factor / 1000.0, colour))
    division, rings = polar_rings(radius_mm, factor)
    figure.update_layout(title=f"{title}, {division:g} µm per division", polar=polar_axes(radius_mm, rings, plane))
    # Above the plot the legend would hide what stands at 90 degrees.
    return styled(figure).update_layout(legend={"y": -0.08, "yanchor": "top"})


def polar_rings(radius_mm: float, magnification: float) -> tuple[float, dict[str, list[Any]]]:
    """Return the µm of one division of a polar plot, and its rings with their names in µm."""
    division = _round_factor(0.2 * radius_mm * 1000.0 / magnification)
    steps = [step * division for step in range(-3, 4)]
    rings = [step for step in steps if abs(step) * magnification / 1000.0 <= _REACH * radius_mm]
    places = [radius_mm + ring * magnification / 1000.0 for ring in rings]
    return division, {"tickvals": places, "ticktext": [f"{ring:+g}" if ring else "0" for ring in rings]}


def polar_axes(radius_mm: float, rings: Mapping[str, Any], plane: str | None) -> dict[str, Any]:
    """Return the layout of a polar plot with rings in µm; ``plane``: two axes, the first of which lies at 0 degrees."""
    corners = {"tickmode": "array", "tickvals": [0, 90, 180, 270]} if plane else {}
    named = {"ticktext": [f"+{plane[0]}", f"+{plane[1]}", f"-{plane[0]}", f"-{plane[1]}"]} if plane else {}
    look = {"tickfont": {"size": 10, "color": "#666666"}, "angle": 45, "tickangle": 45, "ticks": "", "showline": False}
    return {
        "radialaxis": {"range": [0.0, (1.0 + _REACH) * radius_mm], "tickmode": "array", **rings, **look},
        "angularaxis": {"rotation": 0, "direction": "counterclockwise", **corners, **named},
    }


def _start(angle_deg: Floats, drawn: Floats, colour: str) -> go.Scatterpolar:
    """Return where a run starts and which way it goes, as a dot and an arrow; radii in drawn millimetres."""
    ahead = int(np.argmax(np.abs(angle_deg - angle_deg[0]) > _ARROW_DEG))
    places = [0, ahead]
    # A triangle points up; along the path it leans to the left by the angle, and is turned over clockwise.
    backwards = angle_deg[ahead] < angle_deg[0]
    marker = {
        "color": colour,
        "size": [10, 15 if ahead else 0],
        "opacity": 1.0,
        "line": {"color": "white", "width": 1.5},
        "symbol": ["circle", "triangle-up"],
        "angle": [0.0, float((180.0 if backwards else 0.0) - angle_deg[ahead])],
    }
    return go.Scatterpolar(
        theta=[float(angle_deg[p]) for p in places],
        r=[float(drawn[p]) for p in places],
        mode="markers",
        marker=marker,
        showlegend=False,
        hoverinfo="skip",
    )


def error_figure(
    traces: Mapping[str, tuple[Floats, Floats]],
    *,
    title: str,
    floor_um: float | None = None,
    x_title: str = "path angle, deg",
    y_title: str = "error, µm",
) -> go.Figure:
    """Return error, or another length in µm, over the path angle, or over something else.

    ``traces``: as for :func:`polar_figure`.
    """
    figure = go.Figure()
    for colour, (name, (angle, error)) in zip(_PALETTE * 4, traces.items(), strict=False):
        draw_line(figure, _short(angle), _short(error), name, color=colour, width=1.5)
    figure.update_layout(title=title, xaxis_title=x_title, yaxis_title=y_title)
    if floor_um is not None:
        draw_floor_band(figure, floor_um)
    return styled(figure)


def places_figure(
    across_mm: Floats, up_mm: Floats, off_um: Floats, *, title: str, axes: tuple[str, str] = ("X", "Y")
) -> go.Figure:
    """Return places (n,) as seen along an axis, in the colour of how far each is off."""
    figure = error_figure({}, title=title, x_title=f"{axes[0]}, mm", y_title=f"{axes[1]}, mm")
    figure.add_scatter(
        x=across_mm.round(2),
        y=up_mm.round(2),
        mode="markers",
        marker={"color": off_um.round(2), "colorscale": "Viridis", "size": 9, "colorbar": {"title": "µm"}},
        hovertemplate=f"{axes[0]} %{{x}} mm, {axes[1]} %{{y}} mm: %{{marker.color}} µm<extra></extra>",
    )
    figure.update_yaxes(scaleanchor="x")
    return figure


def draw_line(
    figure: go.Figure, x: Any, y: Any, name: str, *, mode: str | None = "lines", hover: str | None = None, **line: Any
) -> None:
    """Draw a curve into a figure; ``line``: its ``color``, ``width`` and ``dash``."""
    figure.add_trace(go.Scatter(x=x, y=y, mode=mode, name=name, hovertemplate=hover, line=line))


def draw_floor_band(figure: go.Figure, floor_um: float) -> None:
    """Draw the noise floor as a band about zero into a figure with the error in um upwards."""
    if not np.isfinite(floor_um):
        say_no_floor(figure)
        return
    figure.add_hrect(
        y0=-floor_um,
        y1=floor_um,
        fillcolor=COLOURS["floor"],
        opacity=0.25,
        line_width=0,
        layer="below",
        annotation_text=f"noise floor ±{floor_um:z.2f} µm",
        annotation_position="bottom right",
        annotation_bgcolor=BEHIND_TEXT,
    )


def floor_rings(floor_um: float | None) -> list[tuple[str, float, dict[str, Any]]]:
    """Return name, error in um and look of the rings of a polar plot, none when not known.

    The second ring is filled down to the first.
    """
    if floor_um is None or not np.isfinite(floor_um):
        return []
    name, line = f"noise floor ±{floor_um:z.2f} µm", {"color": COLOURS["floor"], "width": 0}
    inner = {"line": line, "showlegend": False, "hoverinfo": "skip"}
    outer = {"line": line, "fill": "tonext", "fillcolor": "rgba(153,153,153,0.25)"}
    return [("", -floor_um, inner), (name, floor_um, {**outer, "hoverinfo": "skip"})]


def say_no_floor(figure: go.Figure) -> None:
    """Write into a figure that the noise floor is not known."""
    figure.add_annotation(
        text="noise floor not known",
        xref="paper",
        yref="paper",
        x=1.0,
        y=0.0,
        xanchor="right",
        yanchor="bottom",
        showarrow=False,
        bgcolor=BEHIND_TEXT,
    )


def spectrum_figure(frequency_hz: Floats, amplitude_um: Floats, floor_um: float, *, title: str) -> go.Figure:
    """Return the amplitude spectrum of a run; ``floor_um``: what noise alone rarely exceeds, NaN draws nothing."""
    figure, hover = go.Figure(), "%{x:z.2f} Hz: %{y:z.3f} µm<extra></extra>"
    x, y = _short(frequency_hz), _short(amplitude_um)
    draw_line(figure, x, y, "amplitude", hover=hover, color=COLOURS["measured"], width=1.3)
    if np.isfinite(floor_um):
        figure.add_hline(
            y=floor_um,
            line={"color": COLOURS["floor"], "dash": "dash"},
            annotation_text=f"noise of one line {floor_um:z.3f} µm",
        )
    figure.update_layout(
        title=title, xaxis_title="frequency, Hz", yaxis={"title": "amplitude, µm", "rangemode": "tozero"}
    )
    return styled(figure)


def magnification_for(largest_um: float, radius_mm: float) -> float:
    """Return the round magnification that draws the largest error as about a third of the radius."""
    return _round_factor(0.35 * radius_mm * 1000.0 / max(largest_um, 1e-9))


def styled(figure: go.Figure) -> go.Figure:
    """Give a figure the look of all dtwin's figures; a height that was chosen stays."""
    give_look(figure)
    figure.update_layout(
        height=figure.layout.height or 460,
        title_font_size=15,
        margin={"l": 60, "r": 30, "t": 95, "b": 60},
        font={"family": "system-ui, sans-serif", "size": 13},
        legend={"orientation": "h", "y": 1.0, "yanchor": "bottom"},
    )
    return figure


def give_look(figure: go.Figure) -> None:
    """Give a figure Plotly's white look, unchecked as Plotly gives its default one: to check it takes longer than to make a figure."""
    figure.layout._validate = False
    figure.layout.template = pio.templates["plotly_white"]
    figure.layout._validate = True


def _short(values: Floats) -> list[float]:
    """Thin a long curve and round it: a report is looked at, not computed with."""
    step = max(1, len(values) // 1500)
    return [round(float(v), 4) for v in np.asarray(values)[::step]]


def _round_factor(value: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is not above a value; a billionth for a smaller one."""
    value = max(value, 1e-9)
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(m * power for m in (1.0, 2.0, 5.0) if m * power <= value * (1 + 1e-9)))
