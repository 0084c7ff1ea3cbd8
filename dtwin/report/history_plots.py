"""A machine over time: the figure that stands for each test, with its uncertainty, limit and events."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import plotly.graph_objects as go

from dtwin.report.plots import COLOURS, styled

_PALETTE = [COLOURS[name] for name in ("measured", "second", "third", "fourth")]


def history_figure(tests: Sequence[Mapping[str, Any]], events: Sequence[Mapping[str, Any]]) -> go.Figure:
    """Return the tests of a machine over their days.

    Parameters
    ----------
    tests : sequence of mapping
        With ``started``, ``figure``, ``value_um``, ``expanded_um``, ``limit_um`` and ``campaign``; those without
        a value are left out.
    events : sequence of mapping
        With ``on`` and ``what``.
    """
    figure = go.Figure()
    shown = [t for t in tests if t["value_um"] is not None and t["started"]]
    symbols = list(dict.fromkeys(t["figure"] for t in shown))
    for colour, symbol in zip(_PALETTE * 4, symbols, strict=False):
        mine = [t for t in shown if t["figure"] == symbol]
        figure.add_trace(
            go.Scatter(
                x=[t["started"] for t in mine],
                y=[t["value_um"] for t in mine],
                error_y={"type": "data", "array": [t["expanded_um"] or 0.0 for t in mine]},
                mode="lines+markers",
                name=symbol,
                text=[f"{t['campaign']}, {t['condition']}" for t in mine],
                hovertemplate="%{text}<br>%{y:z.2f} µm<extra>" + symbol + "</extra>",
                line={"color": colour, "width": 1.5},
            )
        )
        for limit in {t["limit_um"] for t in mine if t["limit_um"] is not None}:
            figure.add_hline(
                y=limit, line={"color": colour, "dash": "dash", "width": 1}, annotation_text=f"{symbol} ≤ {limit:g}"
            )
    for event in events:
        figure.add_vline(x=event["on"], line={"color": COLOURS["floor"], "dash": "dot", "width": 1})
        figure.add_annotation(x=event["on"], y=1.0, yref="paper", text=event["what"], showarrow=False, yanchor="bottom")
    figure.update_layout(title="Largest figure of each test; bars cover 95 %", yaxis_title="µm")
    return styled(figure).update_layout(legend={"y": -0.15, "yanchor": "top"})
