"""A figure of a machine from test to test: levels, limits, events, and the control chart behind an alarm."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime, timedelta
from typing import Any

import plotly.graph_objects as go
from plotly.subplots import make_subplots

from dtwin.report.plots import COLOURS, styled

_BAND = "rgba(0,114,178,0.15)"


def series_figure(series: Mapping[str, Any], events: Sequence[Mapping[str, Any]]) -> go.Figure:
    """Return a figure over the days of its tests, with its levels between changes, and what happened on which day."""
    points, unit = series["points"], series["unit"]
    days = [p["started"] for p in points]
    alarms = set(series["chart"]["alarms"])
    figure = go.Figure()
    for regime in series["chart"]["regimes"]:
        part = slice(regime["first"], regime["last"] + 1)
        _add_level(figure, days[part], regime)
    figure.add_trace(
        go.Scatter(
            x=days,
            y=[p["value"] for p in points],
            error_y={"type": "data", "array": [p["expanded"] or 0.0 for p in points], "width": 3},
            mode="markers",
            name=series["name"],
            text=[f"{p['campaign']}{', alarm' if i in alarms else ''}" for i, p in enumerate(points)],
            hovertemplate="%{text}<br>%{y:.3~r} " + unit + "<extra></extra>",
            marker={
                "color": [COLOURS["second" if i in alarms else "measured"] for i in range(len(points))],
                "symbol": ["diamond" if i in alarms else "circle" for i in range(len(points))],
                "size": 8,
            },
        )
    )
    for limit in (series["low"], series["high"]):
        if limit is not None:
            line = {"color": COLOURS["second"], "dash": "dash", "width": 1}
            figure.add_hline(y=limit, line=line, annotation_text=f"limit {limit:g}")
    for event in events:
        figure.add_vline(x=event["on"], line={"color": COLOURS["floor"], "dash": "dot", "width": 1})
        figure.add_annotation(x=event["on"], y=1.0, yref="paper", text=event["what"], showarrow=False, yanchor="bottom")
    figure.update_layout(title=series["name"], yaxis_title=unit, showlegend=False)
    return styled(_over_days(figure, days))


def chart_figure(series: Mapping[str, Any]) -> go.Figure:
    """Return single values, EWMA and CUSUM of a series with their limits, in standard deviations."""
    chart, points = series["chart"], series["points"]
    days, limits = [p["started"] for p in points], chart["limits"]
    names = ("single values", "EWMA", "CUSUM")
    figure = make_subplots(rows=3, cols=1, shared_xaxes=True, subplot_titles=names, vertical_spacing=0.08)
    curves = (
        (1, "single", "measured"),
        (2, "ewma", "measured"),
        (3, "cusum_up", "measured"),
        (3, "cusum_down", "third"),
    )
    for row, name, colour in curves:
        shown = {"cusum_up": "upwards", "cusum_down": "downwards"}.get(name, name)
        trace = go.Scatter(x=days, y=chart[name], mode="lines+markers", name=shown, line={"color": COLOURS[colour]})
        figure.add_trace(trace, row=row, col=1)
    for row, limit in enumerate(limits.values(), start=1):
        for y in (limit,) if row == 3 else (limit, -limit):
            figure.add_hline(y=y, line={"color": COLOURS["second"], "dash": "dash", "width": 1}, row=row, col=1)
    figure.update_layout(title=f"Control chart of {series['name']}, in standard deviations", showlegend=False)
    return styled(_over_days(figure, days))


def _over_days(figure: go.Figure, days: Sequence[str]) -> go.Figure:
    """Show a day before and after tests of one day, which would else stand over fractions of a second."""
    # Some tests state a time zone, others none.
    first, last = (datetime.fromisoformat(day).replace(tzinfo=None) for day in (min(days), max(days)))
    if last - first < timedelta(days=2):
        figure.update_xaxes(range=[(first - timedelta(days=1)).isoformat(), (last + timedelta(days=1)).isoformat()])
    return figure


def _add_level(figure: go.Figure, days: Sequence[str], regime: Mapping[str, Any]) -> None:
    """Add the level of tests between two changes with the band that covers 95 %; of a trend, its line."""
    look: dict[str, Any] = {"mode": "lines", "hoverinfo": "skip"}
    if regime["trend"] and regime["slope"] is not None:
        ends = [days[0], days[-1]]
        figure.add_trace(go.Scatter(x=ends, y=regime["ends"], line={"color": COLOURS["third"], "width": 2}, **look))
        return
    mean, half = regime["mean"], regime["expanded"]
    ends = [days[0], days[-1]]
    if half is not None:
        corners = [mean - half, mean - half, mean + half, mean + half]
        figure.add_trace(
            go.Scatter(x=[*ends, *ends[::-1]], y=corners, fill="toself", fillcolor=_BAND, line={"width": 0}, **look)
        )
    figure.add_trace(go.Scatter(x=ends, y=[mean, mean], line={"color": COLOURS["floor"], "width": 1.5}, **look))
