"""Figures of a twin: overlay, residual map, waterfall, ranked effects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go

from dtwin.report.plots import COLOURS, magnification_for, styled
from dtwin.schema import Floats

_STEPS = (0.25, 0.5, 1.0, 2.0, 4.0)


def overlay_figure(curves: Mapping[str, Floats], radius_mm: float, *, title: str) -> go.Figure:
    """Return a polar overlay whose magnification the reader chooses.

    Parameters
    ----------
    curves : mapping of str to ndarray, shape (360,)
        Error over the angle by name, um, one value for each degree.
    radius_mm : float
        Nominal radius.
    title : str
        Heading.
    """
    largest = max((float(np.nanmax(np.abs(c))) for c in curves.values()), default=1.0)
    fitting = magnification_for(largest, radius_mm)
    angle = [*(np.arange(360) + 0.5), 0.5]
    figure = go.Figure()
    figure.add_trace(
        go.Scatterpolar(
            theta=angle, r=[radius_mm] * 361, mode="lines", name="nominal",
            line={"color": COLOURS["floor"], "width": 1, "dash": "dot"}, hoverinfo="skip",
        )
    )  # fmt: skip
    colours = (COLOURS["measured"], COLOURS["second"], COLOURS["third"], COLOURS["fourth"])
    for colour, (name, curve) in zip(colours * 3, curves.items(), strict=False):
        figure.add_trace(
            go.Scatterpolar(
                theta=angle, r=_drawn(curve, radius_mm, fitting), mode="lines", name=name,
                line={"color": colour, "width": 1.6}, customdata=_closed(curve),
                hovertemplate="%{theta:.0f} deg<br>%{customdata:.2f} um<extra>" + name + "</extra>",
            )
        )  # fmt: skip
    steps = [
        {
            "method": "restyle",
            "label": f"{factor:g} x",
            "args": [
                {"r": [[radius_mm] * 361, *(_drawn(c, radius_mm, factor) for c in curves.values())]}
            ],
        }
        for factor in (fitting * step for step in _STEPS)
    ]
    figure.update_layout(
        title=title,
        polar={
            "radialaxis": {"range": [0.0, 1.5 * radius_mm], "showticklabels": False, "ticks": ""},
            "angularaxis": {"rotation": 0, "direction": "counterclockwise"},
        },
        sliders=[
            {"active": _STEPS.index(1.0), "steps": steps, "currentvalue": {"prefix": "magnified "}}
        ],
        height=560,
    )
    return styled(figure)


def residual_map(
    means_um: Floats, conditions: Sequence[str], *, floor_um: float, title: str
) -> go.Figure:
    """Return the mean residual of every condition over the angle.

    Parameters
    ----------
    means_um : ndarray, shape (conditions, 360)
        Mean residual.
    conditions : sequence of str
        Names.
    floor_um : float
        Noise floor; where the mean is within two of its standard errors nothing is shown.
    title : str
        Heading.
    """
    smooth = means_um.reshape(len(means_um), 72, 5).mean(axis=2)
    limit = float(np.nanmax(np.abs(smooth))) or 1.0
    figure = go.Figure(
        go.Heatmap(
            x=np.arange(72) * 5.0 + 2.5,
            y=list(conditions),
            z=np.round(smooth, 3),
            zmin=-limit,
            zmax=limit,
            colorscale=[[0.0, "#D55E00"], [0.5, "#FFFFFF"], [1.0, "#0072B2"]],
            colorbar={"title": "um"},
            hovertemplate="%{y}<br>%{x:.0f} deg: %{z:.2f} um<extra></extra>",
        )
    )
    figure.update_layout(
        title=f"{title} (noise floor {floor_um:.2f} um RMS of one run)",
        xaxis_title="path angle, deg",
        height=max(320, 60 + 22 * len(conditions)),
        yaxis={"autorange": "reversed", "dtick": 1},
    )
    return styled(figure)


def waterfall_figure(rungs: Sequence[Mapping[str, Any]]) -> go.Figure:
    """Return how the error fell from version to version, down to the noise floor.

    Parameters
    ----------
    rungs : sequence of dict
        ``Twins.history``.
    """
    first = rungs[0]
    names = ["set-up only", *(f"v{r['version']} {r['action']}" for r in rungs)]
    heights = [first["rms_before_um"], *(r["rms_after_um"] for r in rungs)]
    figure = go.Figure(
        go.Bar(
            x=names, y=heights, marker_color=[COLOURS["second"]] + [COLOURS["measured"]] * len(rungs),
            text=[f"{h:.2f}" for h in heights], textposition="outside", name="residual RMS",
        )
    )  # fmt: skip
    floor = rungs[-1]["noise_floor_um"]
    if floor is not None:
        figure.add_hline(
            y=floor, line={"color": COLOURS["floor"], "dash": "dash"},
            annotation_text=f"noise floor {floor:.2f} um",
        )  # fmt: skip
    figure.update_layout(title="Error from version to version", yaxis_title="RMS, um")
    return styled(figure)


def ranked_figure(diagnosis: Mapping[str, Any]) -> go.Figure:
    """Return the effects that were considered, by the error predicted after adding each.

    Parameters
    ----------
    diagnosis : dict
        ``Diagnosis.as_dict``.
    """
    rows = list(reversed(diagnosis["candidates"]))
    names = [f"{c['effect']} {c['axis']}".strip() for c in rows]
    figure = go.Figure(
        go.Bar(
            x=[c["rms_after_um"] for c in rows], y=names, orientation="h",
            marker_color=[COLOURS["measured"] if c["in_group"] else "#BBBBBB" for c in rows],
            text=[f"p {c['p_value']:.1g}" for c in rows], name="after adding",
        )
    )  # fmt: skip
    figure.add_vline(x=diagnosis["residual_rms_um"], line={"color": COLOURS["second"]},
                     annotation_text="now")  # fmt: skip
    if np.isfinite(diagnosis["noise_floor_um"]):
        figure.add_vline(
            x=diagnosis["noise_floor_um"], line={"color": COLOURS["floor"], "dash": "dash"},
            annotation_text="noise floor",
        )  # fmt: skip
    figure.update_layout(
        title="Predicted error after adding each effect (blue: the reported group)",
        xaxis_title="RMS, um", height=max(280, 80 + 30 * len(rows)),
    )  # fmt: skip
    return styled(figure)


def _drawn(curve: Floats, radius_mm: float, factor: float) -> list[float]:
    return [round(radius_mm + value * factor / 1000.0, 4) for value in _closed(curve)]


def _closed(curve: Floats) -> list[float]:
    return [round(float(v), 3) for v in (*curve, curve[0])]
