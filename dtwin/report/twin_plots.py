"""Figures of a twin: overlay, residual map, waterfall, ranked effects; ``floor_um`` as in :mod:`dtwin.report.plots`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go

from dtwin.physics.effect import Effect
from dtwin.physics.grid import Grid
from dtwin.physics.gridding import CIRCLE
from dtwin.physics.library import Library
from dtwin.report.faults import in_titles, title_of
from dtwin.report.plots import (
    BEHIND_TEXT,
    COLOURS,
    draw_floor_band,
    draw_line,
    floor_rings,
    magnification_for,
    polar_axes,
    polar_rings,
    say_no_floor,
    styled,
)
from dtwin.report.text import micrometres
from dtwin.schema import Floats

_CURVES = (COLOURS["measured"], COLOURS["second"], COLOURS["third"], COLOURS["fourth"])
_NOMINAL = ("nominal", 0.0, {"line": {"color": COLOURS["floor"], "width": 1, "dash": "dot"}, "hoverinfo": "skip"})
_ALONG = {"angle_deg": "path angle", "position_mm": "position", "phase_deg": "phase of the command"}
_CELLS = 72
_LONGEST_STEP, _MOST_STEPS = 26, 8
# A row of a map, and the highest map.
_ROW_PX, _MAP_PX = 16, 800
_STEPS = (0.25, 0.5, 1.0, 2.0, 4.0)


def overlay_figure(
    curves: Mapping[str, Floats],
    radius_mm: float,
    *,
    title: str,
    floor_um: float | None = None,
    magnification: float | None = None,
    slider: bool = True,
    plane: str | None = None,
) -> go.Figure:
    """Return a polar overlay whose magnification the reader chooses.

    ``layout.meta`` holds ``radius_mm`` and ``magnification``, and every trace its error in um as
    ``customdata``, so that a page can magnify without asking again.

    ``curves``, shape (360,): error over the angle by name, um, one value for each degree; NaN where not measured.
    ``magnification``: where it begins; chosen from the largest error when left out.
    ``slider``: whether the figure has a slider of its own; a page with a script needs none.
    ``plane``: two axes, the first of which lies at 0 degrees.
    """
    largest = max((float(np.nanmax(np.abs(c))) for c in curves.values()), default=1.0)
    fitting = magnification or magnification_for(max(largest, 1e-3), radius_mm)
    angle = [*(np.arange(360) + 0.5), 0.5]
    rings = [(n, np.full(360, um), look) for n, um, look in (*floor_rings(floor_um), _NOMINAL)]
    figure = go.Figure()
    for name, values, look in rings:
        figure.add_trace(
            go.Scatterpolar(
                theta=angle,
                r=_drawn(values, radius_mm, fitting),
                mode="lines",
                name=name,
                customdata=_closed(values),
                **look,
            )
        )
    for colour, (name, curve) in zip(_CURVES * 3, curves.items(), strict=False):
        figure.add_trace(
            go.Scatterpolar(
                theta=angle,
                r=_drawn(curve, radius_mm, fitting),
                mode="lines",
                name=name,
                line={"color": colour, "width": 1.6, "dash": _dash_of(name)},
                customdata=_closed(curve),
                hovertemplate="%{theta:z.0f} deg<br>%{customdata:z.2f} µm<extra>" + name + "</extra>",
            )
        )
    figure.update_layout(
        title=title,
        meta={"radius_mm": radius_mm, "magnification": fitting},
        polar=polar_axes(radius_mm, polar_rings(radius_mm, fitting)[1], plane),
        height=560,
    )
    if floor_um is not None and not math.isfinite(floor_um):
        say_no_floor(figure)
    if slider:
        drawn = [*(values for _, values, _ in rings), *curves.values()]
        figure.update_layout(sliders=[_magnifier(drawn, radius_mm, fitting)])
    made = styled(figure)
    # The legend must not hide what stands at 90 degrees; below the plot there is room where no slider is.
    if slider:
        return made.update_layout(margin_t=125, title_y=0.98, title_yanchor="top", legend_y=1.05)
    return made.update_layout(legend={"y": -0.08, "yanchor": "top"})


def along_figure(curves: Mapping[str, Floats], *, title: str, floor_um: float, grid: Grid = CIRCLE) -> go.Figure:
    """Return error along the path with the noise floor as a band.

    ``curves``, shape (n,): error along the path by name, um; NaN where not measured.
    ``grid``: the points along the path; the degrees of a circle without.
    """
    figure = go.Figure()
    for colour, (name, curve) in zip(_CURVES * 3, curves.items(), strict=False):
        y, hover = (
            [round(float(v), 4) for v in curve],
            "%{x:.4~r} " + _unit(grid) + "<br>%{y:.3~r} µm<extra>" + name + "</extra>",
        )
        draw_line(figure, grid.points, y, name, hover=hover, color=colour, width=1.6, dash=_dash_of(name))
    draw_floor_band(figure, floor_um)
    figure.update_layout(title=title, xaxis=_axis(grid), yaxis_title="error, µm")
    return styled(figure)


def harmonics_figure(curves: Mapping[str, Floats], floor_um: Floats | None, *, title: str, most: int = 60) -> go.Figure:
    """Return the amplitude of every harmonic of the path.

    ``curves``, shape (n,): error over a full turn, travel or period by name, um.
    ``floor_um``, shape (n // 2 + 1,): amplitude by which repeats disagree; None when nothing was repeated.
    ``most``: highest harmonic that is shown.
    """
    figure = go.Figure()
    shortest = min((len(curve) for curve in curves.values()), default=2 * most)
    most = min(most, shortest // 2)
    numbers = np.arange(1, most + 1)
    for colour, (name, curve) in zip(_CURVES * 3, curves.items(), strict=False):
        figure.add_trace(
            go.Bar(
                x=numbers,
                y=np.round(harmonic_amplitudes_um(curve)[1 : most + 1], 4),
                name=name,
                marker_color=colour,
                hovertemplate="%{x} times: %{y:z.3f} µm<extra>" + name + "</extra>",
            )
        )
    if floor_um is not None:
        floor = np.round(floor_um[1 : most + 1], 4)
        draw_line(figure, numbers, floor, "noise floor of one run", color=COLOURS["floor"], dash="dash")
    figure.update_layout(
        title=title,
        barmode="group",
        xaxis_title="undulations along the path",
        yaxis={"title": "amplitude, µm", "rangemode": "tozero"},
    )
    return styled(figure)


def harmonic_amplitudes_um(curve: Floats) -> Floats:
    """Return the amplitudes of the harmonics of an error over a full turn, travel or period, shape (..., n // 2 + 1).

    ``curve``: error in every bin, um, shape (..., n).
    """
    return np.asarray(2.0 * np.abs(np.fft.rfft(curve, axis=-1)) / curve.shape[-1])


def residual_map(
    means_um: Floats, conditions: Sequence[str], *, floor_um: float, title: str, grid: Grid = CIRCLE
) -> go.Figure:
    """Return the mean residual of every condition along the path.

    ``means_um``, shape (conditions, n): mean residual.
    ``floor_um``: noise floor; where the mean is within two of its standard errors nothing is shown.
    ``grid``: the points along the path; the degrees of a circle without.
    """
    edges = np.linspace(0, grid.n, min(_CELLS, grid.n) + 1).round().astype(int)
    smooth = np.add.reduceat(means_um, edges[:-1], axis=1) / np.diff(edges)
    middles = np.add.reduceat(grid.points, edges[:-1]) / np.diff(edges)
    limit = float(np.nanmax(np.abs(smooth))) or 1.0
    figure = go.Figure(
        go.Heatmap(
            x=middles,
            y=list(conditions),
            z=np.round(smooth, 3),
            zmin=-limit,
            zmax=limit,
            colorscale=[[0.0, "#D55E00"], [0.5, "#FFFFFF"], [1.0, "#0072B2"]],
            colorbar={"title": "µm"},
            hovertemplate="%{y}<br>%{x:.4~r} " + _unit(grid) + ": %{z:.3~r} µm<extra></extra>",
        )
    )
    figure.update_layout(
        title=f"{title} ({_floor_words(floor_um)})",
        xaxis=_axis(grid),
        # On paper no higher than a page beside its headline: a higher one would leave the page before it empty.
        height=min(_MAP_PX, max(320, 60 + _ROW_PX * len(conditions))),
        yaxis={"autorange": "reversed", "dtick": -(-_ROW_PX * len(conditions) // _MAP_PX)},
    )
    return styled(figure)


def waterfall_figure(
    rungs: Sequence[Mapping[str, Any]], begun: str = "set-up only", library: Mapping[str, Effect] | None = None
) -> go.Figure:
    """Return how the error fell from version to version (``Twins.history``), down to the noise floor.

    ``begun``: what the error before the first of them is called; ``library``: as for :func:`ranked_figure`.
    """
    library = Library() if library is None else library
    first = rungs[0]
    steps = [begun, *(f"v{r['version']} {in_titles(r['action'], library)}" for r in rungs)]
    # Long steps, or many, would leave no room for the bars; the table beside the plot has them, too.
    short = max(map(len, steps)) <= _LONGEST_STEP and len(steps) <= _MOST_STEPS
    names = steps if short else [begun, *(f"v{r['version']}" for r in rungs)]
    heights = [first["rms_before_um"], *(r["rms_after_um"] for r in rungs)]
    figure = go.Figure(
        go.Bar(
            x=names,
            y=heights,
            marker_color=[COLOURS["second"]] + [COLOURS["measured"]] * len(rungs),
            text=[micrometres(h) for h in heights],
            textposition="outside",
            hovertext=steps,
            name="residual RMS",
        )
    )
    floor = rungs[-1]["noise_floor_um"]
    if floor is not None:
        figure.add_hline(
            y=floor,
            line={"color": COLOURS["floor"], "dash": "dash"},
            annotation_text=f"noise floor {micrometres(floor)} µm",
            annotation_bgcolor=BEHIND_TEXT,
            # The newest bar ends about here, and its height stands above it on the right.
            annotation_position="bottom left",
        )
    figure.update_layout(title="Error from version to version", yaxis_title="RMS, µm")
    return styled(figure)


def ranked_figure(diagnosis: Mapping[str, Any], library: Mapping[str, Effect] | None = None) -> go.Figure:
    """Return the effects that a diagnosis considered, as a mapping, by the error predicted after adding each.

    ``library``: where their names in words are; that of dtwin without.
    """
    library = Library() if library is None else library
    rows = list(reversed(diagnosis["candidates"]))
    names = [title_of(c.get("label", f"{c['effect']} {c['axis']}".strip()), library) for c in rows]
    several = {one["campaign"]: one for one in diagnosis.get("campaigns", ())}
    if several:
        names = [f"{name}, {c['campaign']}" for name, c in zip(names, rows, strict=True)]
    figure = go.Figure(
        go.Bar(
            x=[c["rms_after_um"] for c in rows],
            y=names,
            orientation="h",
            marker_color=[COLOURS["measured"] if c["in_group"] else "#BBBBBB" for c in rows],
            text=[f"{micrometres(c['rms_after_um'])} µm" for c in rows],
            # Where the bars end, the line of what is left now stands.
            insidetextanchor="start",
            name="after adding",
        )
    )
    floor = diagnosis["noise_floor_um"]
    if several:
        # Each campaign has a residual and a noise floor of its own.
        for name, field, colour in (("now", "residual_rms_um", "second"), ("noise floor", "noise_floor_um", "floor")):
            figure.add_scatter(
                x=[several[c["campaign"]][field] if c["campaign"] in several else None for c in rows],
                y=names,
                mode="markers",
                name=f"{name}, of that campaign",
                marker={"symbol": "line-ns", "size": 18, "line": {"color": COLOURS[colour], "width": 2}},
            )
        floor = None
    else:
        figure.add_vline(x=diagnosis["residual_rms_um"], line={"color": COLOURS["second"]}, annotation_text="now")
    if floor is not None and np.isfinite(floor):
        figure.add_vline(
            x=floor,
            line={"color": COLOURS["floor"], "dash": "dash"},
            annotation_text="noise floor",
            annotation_position="top left",
        )
    figure.update_layout(
        title="Predicted error after adding each (blue: reported)",
        xaxis_title="RMS, µm",
        height=max(320, 170 + 30 * len(rows)),
        # The names of the lines stand above the bars.
        yaxis_range=[-0.6, len(rows) + 0.2],
    )
    # The legend, which only several campaigns have, has room below.
    return styled(figure).update_layout(legend={"y": -0.12, "yanchor": "top"})


def _unit(grid: Grid) -> str:
    return grid.coordinate.rpartition("_")[2]


def _axis(grid: Grid) -> dict[str, Any]:
    """Return how the coordinate of a path is drawn; full turns are divided as on a dial."""
    turn = {"range": [0, 360], "dtick": 45} if _unit(grid) == "deg" else {}
    return {"title": f"{_ALONG[grid.coordinate]}, {_unit(grid)}", **turn}


def _dash_of(name: str) -> str:
    """Return the line of a curve: what is computed is dashed, also for eyes without colours."""
    return "dash" if name.startswith(("predicted", "twin")) else "solid"


def _magnifier(drawn: Sequence[Floats], radius_mm: float, fitting: float) -> dict[str, Any]:
    steps = [
        {
            "method": "update",
            "label": f"{factor:g} x",
            "args": [
                {"r": [_drawn(curve, radius_mm, factor) for curve in drawn]},
                {f"polar.radialaxis.{name}": ticks for name, ticks in polar_rings(radius_mm, factor)[1].items()},
            ],
        }
        for factor in (fitting * step for step in _STEPS)
    ]
    return {"active": _STEPS.index(1.0), "steps": steps, "currentvalue": {"prefix": "magnified "}}


def _floor_words(floor_um: float) -> str:
    if not math.isfinite(floor_um):
        return "noise floor not known"
    return f"noise floor {micrometres(floor_um)} µm RMS of one run"


def _drawn(curve: Floats, radius_mm: float, factor: float) -> list[float]:
    return [round(radius_mm + value * factor / 1000.0, 4) for value in _closed(curve)]


def _closed(curve: Floats) -> list[float]:
    return [round(float(v), 3) for v in (*curve, curve[0])]
