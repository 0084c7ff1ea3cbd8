"""Figures of learned models and of their serving.

A noise floor is drawn with its 95 % interval where its degrees of freedom, ``floor_dof``, are known.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go

from dtwin.report.plots import COLOURS, draw_line, styled
from dtwin.report.text import classes
from dtwin.statistics import deviation_interval
from dtwin.train.results import condition_name

_PROMOTABLE = "expression, promotable"
_LOWEST_R2 = -0.5
_FAR = 100.0
_ERRORS = "Error, RMS after set-up; bars: 95 % over runs; *: not trained"


def evidence_figure(evidence: Mapping[str, Any]) -> go.Figure:
    """Return error before and after per condition, with the oracle and the noise floor, of ``Evidence.as_dict``."""
    conditions = evidence["conditions"]
    names = [condition_name(c) + (" *" if c["trained"] is False else "") for c in conditions]
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
            marker={"symbol": "line-ew-open", "size": 22, "color": COLOURS["third"], "line": {"width": 3}},
        )
    )
    draw_line(figure, names, [c["floor_um"] for c in conditions], "noise floor", color=COLOURS["floor"], dash="dash")
    figure.update_layout(title=_ERRORS, yaxis_title="µm", barmode="group")
    return styled(figure)


def comparison_figure(candidates: Sequence[Mapping[str, Any]], floor_um: float, floor_dof: float = 0) -> go.Figure:
    """Return held-out error against latency, one point per candidate.

    ``candidates``: with ``name``, ``rms_um``, ``p50_us`` (may be None) and ``promotable``.
    """
    figure = _over_latency(candidates, lambda c: c["rms_um"], "%{y:z.1f} µm")
    # What may be promoted is fast, and stands at the left edge.
    figure.update_traces(textposition="top right").update_traces(mode="markers+text", selector={"name": _PROMOTABLE})
    axis = _range_of([c["rms_um"] for c in candidates])
    if not np.isnan(floor_um):
        figure.add_hline(y=floor_um, line_dash="dash", line_color=COLOURS["floor"])
        _draw_band(figure, floor_um, floor_dof)
        figure.add_annotation(
            text="noise floor",
            xref="paper",
            x=1.0,
            xanchor="right",
            yanchor="bottom",
            # Shapes take the value itself, annotations its logarithm.
            y=float(np.log10(floor_um)) if "type" in axis else floor_um,
            showarrow=False,
        )
    figure.update_layout(
        title="Error on conditions left out against time of one row (hover for names)",
        xaxis={"title": "median time of one row, µs", "type": "log"},
        yaxis={"title": "held-out RMS, µm", **axis},
    )
    return styled(figure)


def r2_figure(candidates: Sequence[Mapping[str, Any]]) -> go.Figure:
    """Return R2 on feeds left out against latency, one point per candidate.

    ``candidates``: with ``name``, ``r2``, ``r2_text``, ``p50_us`` (may be None) and ``promotable``.
    """
    figure = _over_latency(candidates, lambda c: max(c["r2"], _LOWEST_R2), "R² %{customdata}", "r2_text")
    figure.add_hline(y=0.0, line_dash="dash", line_color=COLOURS["floor"], annotation_text="no correction")
    figure.update_layout(
        title=f"R² on feeds left out against time of one row (below {_LOWEST_R2:g}: at the edge)",
        xaxis={"title": "median time of one row, µs", "type": "log"},
        yaxis={"title": "R², held out"},
    )
    return styled(figure)


def _over_latency(
    candidates: Sequence[Mapping[str, Any]], value: Callable[[Mapping[str, Any]], float], shown: str, told: str = ""
) -> go.Figure:
    """Return a value of each candidate over its latency; ``shown``: the value where the pointer is; ``told``: its words."""
    figure = go.Figure()
    for promotable, colour in ((True, COLOURS["second"]), (False, COLOURS["measured"])):
        chosen = [c for c in candidates if c["promotable"] == promotable and c["p50_us"]]
        figure.add_trace(
            go.Scatter(
                x=[c["p50_us"] for c in chosen],
                y=[value(c) for c in chosen],
                customdata=[c[told] for c in chosen] if told else None,
                text=[c["name"] for c in chosen],
                mode="markers",
                hovertemplate="%{text}<br>%{x:.3~r} µs, " + shown + "<extra></extra>",
                name=_PROMOTABLE if promotable else "comparison only",
                marker={"size": 12, "color": colour, "symbol": "circle" if promotable else "square"},
            )
        )
    return figure


def front_figure(front: Sequence[Mapping[str, Any]], floor_um: float, floor_dof: float = 0) -> go.Figure:
    """Return the error that chose the size of the equation, over that size.

    ``front``: with ``terms``, ``held_out_rms_um`` and ``radius_out_rms_um``.
    """
    figure = go.Figure()
    terms = [point["terms"] for point in front]
    for name, key, colour in (
        ("coefficients without the feed", "held_out_rms_um", COLOURS["measured"]),
        ("coefficients without the radius", "radius_out_rms_um", COLOURS["second"]),
    ):
        draw_line(figure, terms, [point[key] for point in front], name, mode="lines+markers", color=colour)
    figure.add_hline(y=floor_um, line_dash="dash", line_color=COLOURS["floor"], annotation_text="noise floor")
    _draw_band(figure, floor_um, floor_dof)
    figure.update_layout(
        title="Accuracy and complexity of the physics library (orders and modes found on all runs)",
        xaxis_title="terms",
        yaxis={"title": "RMS, µm", "rangemode": "tozero"},
    )
    return styled(figure)


def _draw_band(figure: go.Figure, floor_um: float, floor_dof: float) -> None:
    if floor_dof:
        low, high = deviation_interval(floor_um, floor_dof)
        figure.add_hrect(y0=low, y1=high, fillcolor=COLOURS["floor"], opacity=0.15, line_width=0)


def _range_of(values: Sequence[float]) -> dict[str, str]:
    """Return a logarithmic axis where one value would flatten all others."""
    far = max(values, default=0.0) > _FAR * min(values, default=0.0)
    return {"type": "log"} if far else {"rangemode": "tozero"}


def jitter_figure(histogram: Mapping[str, int]) -> go.Figure:
    """Return how far the periods of a serving session were off: ticks by jitter in us, of ``LoopTiming.summary``."""
    top = float(np.ceil(np.log10(max([*histogram.values(), 10]))))
    figure = go.Figure(go.Bar(x=classes(histogram), y=list(histogram.values()), marker_color=COLOURS["measured"]))
    figure.update_layout(
        title="Jitter of the period",
        xaxis={"title": "distance from the nominal period, µs", "type": "category"},
        yaxis={"title": "ticks (logarithmic)", "type": "log", "dtick": 1, "range": [-0.3, top]},
    )
    return styled(figure)
