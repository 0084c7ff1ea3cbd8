"""A figure of a machine from test to test: levels, limits, events, and the control chart behind an alarm."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from datetime import datetime, timedelta
from typing import Any

import plotly.graph_objects as go
from plotly.subplots import make_subplots

from dtwin.report.plots import COLOURS, styled

_BAND, _FLOOR_BAND = "rgba(0,114,178,0.2)", "rgba(153,153,153,0.25)"

_LINE_PX = 16
_DAY_MS = 86_400_000
_DAYS = [
    {"dtickrange": [None, _DAY_MS - 1], "value": "%H:%M\n%Y-%m-%d"},
    {"dtickrange": [_DAY_MS, "M1"], "value": "%Y-%m-%d"},
    {"dtickrange": ["M1", None], "value": "%Y-%m"},
]


def series_figure(series: Mapping[str, Any], events: Sequence[Mapping[str, Any]]) -> go.Figure:
    """Return a figure over the days of its tests: levels between changes, the noise floor of tests about each, events, limits."""
    points, unit = series["points"], series["unit"]
    days = [p["started"] for p in points]
    alarms = set(series["chart"]["alarms"])
    figure = go.Figure()
    for regime in series["chart"]["regimes"]:
        _add_floor(figure, days, regime)
    for regime in series["chart"]["regimes"]:
        _add_level(figure, days, regime)
    calm = [i for i in range(len(points)) if i not in alarms]
    for name, colour, symbol, shown in (
        ("test, with U (95 %)", "measured", "circle", calm),
        ("test that raised an alarm", "second", "diamond", sorted(alarms)),
    ):
        if shown:
            figure.add_trace(
                go.Scatter(
                    x=[days[i] for i in shown],
                    y=[points[i]["value"] for i in shown],
                    error_y={"type": "data", "array": [points[i]["expanded"] or 0.0 for i in shown], "width": 3},
                    mode="markers",
                    name=name,
                    text=[points[i]["campaign"] for i in shown],
                    hovertemplate="%{text}<br>%{y:.3~r} " + unit + "<extra></extra>",
                    marker={"color": COLOURS[colour], "symbol": symbol, "size": 8},
                )
            )
    for limit in (series["low"], series["high"]):
        if limit is not None:
            line = {"color": COLOURS["second"], "dash": "dash", "width": 1}
            figure.add_hline(y=limit, line=line, annotation_text=f"limit {limit:g}", annotation_position="top left")
    told = Counter[str]()
    for event in events:
        figure.add_vline(x=event["on"], line={"color": COLOURS["floor"], "dash": "dot", "width": 1})
        above = {"y": 1.0, "yref": "paper", "yanchor": "bottom", "yshift": _LINE_PX * told[event["on"]]}
        figure.add_annotation(x=event["on"], text=event["what"], showarrow=False, **above)
        told[event["on"]] += 1
    figure.update_layout(title=series["name"], yaxis_title=unit)
    # Below, so that the names of events stay above.
    return styled(_over_days(figure, days)).update_layout(legend={"y": -0.15, "yanchor": "top"})


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
    """Write days as everywhere, in no language; show one before and after tests of one day, which would else stand over fractions of a second."""
    figure.update_xaxes(tickformatstops=_DAYS)
    # Some tests state a time zone, others none.
    first, last = (datetime.fromisoformat(day).replace(tzinfo=None) for day in (min(days), max(days)))
    if last - first < timedelta(days=2):
        figure.update_xaxes(range=[(first - timedelta(days=1)).isoformat(), (last + timedelta(days=1)).isoformat()])
    return figure


def _add_floor(figure: go.Figure, days: Sequence[str], regime: Mapping[str, Any]) -> None:
    """Add the band in which another test lies with 95 % while nothing changes, where that is known."""
    if (half := regime["floor"]) is None:
        return
    name = "noise floor: 95 % of tests while nothing changes"
    low, high = regime["ends"] if regime["trend"] else (regime["mean"], regime["mean"])
    _add_band(figure, days, regime, (low, high), half, name, _FLOOR_BAND)


def _add_level(figure: go.Figure, days: Sequence[str], regime: Mapping[str, Any]) -> None:
    """Add the level of tests between two changes with the band that covers 95 % of it; of a trend, its line."""
    ends = [days[regime["first"]], days[regime["last"]]]
    if regime["trend"] and regime["slope"] is not None:
        name, heights, line = "trend", regime["ends"], {"color": COLOURS["third"], "width": 2}
    else:
        mean, half = regime["mean"], regime["expanded"]
        name, heights, line = "level", [mean, mean], {"color": COLOURS["floor"], "width": 1.5}
        if half is not None:
            _add_band(figure, days, regime, (mean, mean), half, "where the level lies, with 95 %", _BAND)
    figure.add_trace(go.Scatter(x=ends, y=heights, mode="lines", line=line, hoverinfo="skip", **_once(figure, name)))


def _add_band(
    figure: go.Figure,
    days: Sequence[str],
    regime: Mapping[str, Any],
    about: tuple[float, float],
    half: float,
    name: str,
    colour: str,
) -> None:
    """Add a band of one height about a line from the first test of a regime to its last one."""
    ends, (low, high) = [days[regime["first"]], days[regime["last"]]], about
    figure.add_trace(
        go.Scatter(
            x=[*ends, *ends[::-1]],
            y=[low - half, high - half, high + half, low + half],
            mode="lines",
            fill="toself",
            fillcolor=colour,
            line={"width": 0},
            hoverinfo="skip",
            **_once(figure, name),
        )
    )


def _once(figure: go.Figure, name: str) -> dict[str, Any]:
    """Return the name of a trace, which stands in the legend once for all of the same name."""
    return {"name": name, "legendgroup": name, "showlegend": all(trace.name != name for trace in figure.data)}
