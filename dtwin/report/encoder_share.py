"""What the controller saw of the error, as text and as a section of a report."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import plotly.graph_objects as go

from dtwin.report.html import Section, Table
from dtwin.report.plots import COLOURS, styled
from dtwin.report.text import table

_SHOWN = {"measured": "measured", "controller": "controller saw", "quasi_static": "quasi-static", "dynamic": "dynamic"}
_COLOURS = dict(zip(_SHOWN, ("measured", "second", "third", "fourth"), strict=True))


def tells(split: Mapping[str, Any] | None) -> bool:
    """Return whether the controller saw anything of the error; one that reports what it commanded saw nothing."""
    return split is not None and split["parts"]["controller"]["rms_um"] > 0.0


def encoder_text(split: Mapping[str, Any]) -> str:
    """Return the split for the terminal. ``split``: ``encoder_split`` of a comparison."""
    head, rows = _cells(split)
    lines = ["", f"measured error by who can see it, µm RMS ± noise floor; {_said(split)}"]
    return "\n".join([*lines, table(head, rows), *_notes(split)])


def encoder_section(split: Mapping[str, Any]) -> Section:
    """Return ``encoder_split`` of a comparison as a section with a table and a plot."""
    head, rows = _cells(split)
    return Section(
        "What the controller saw",
        [
            "Measured error = what the controller saw (encoder minus command, along the radius) "
            f"+ quasi-static + dynamic error; {_said(split)}. Each cell: µm RMS over the runs of "
            "the condition ± what its repeats disagree by.",
            *_notes(split),
        ],
        [],
        [Table(head, rows)],
        [_figure(split)],
    )


def _said(split: Mapping[str, Any]) -> str:
    cutoff = split["cutoff"]
    if "hz" in cutoff:
        return f"dynamic is above {cutoff['hz']:g} Hz"
    return f"dynamic is above {cutoff['cycles_per_rev']:g} cycles per revolution"


def _cells(split: Mapping[str, Any]) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    head = ("condition", "runs", *_SHOWN.values(), "correlation")
    rows = [(_name(c), str(c["runs"]), *_figures(c)) for c in split["conditions"]]
    rows.append(("all", str(split["runs"]), *_figures(split["parts"])))
    return head, rows


def _figures(figures: Mapping[str, Any]) -> tuple[str, ...]:
    parts = [figures[name] for name in _SHOWN]
    sizes = [f"{p['rms_um']:z.2f} ± {_number(p['floor_um'])}" for p in parts]
    return (*sizes, _number(figures["controller_correlation"]))


def _notes(split: Mapping[str, Any]) -> Iterator[str]:
    yield (
        "The parts add up at every angle; their squares do so only where the correlation of the "
        "controller's part with the rest is zero. A sharp step (lost motion at a reversal) has "
        "high frequencies too: its corner counts as dynamic."
    )
    without = split["runs_without_controller"]
    if without:
        yield f"{len(without)} runs without the controller's positions are left out."


def _figure(split: Mapping[str, Any]) -> go.Figure:
    names = [_name(c) for c in split["conditions"]]
    figure = go.Figure(
        [
            go.Bar(
                name=shown,
                y=names,
                x=[c[part]["rms_um"] for c in split["conditions"]],
                orientation="h",
                marker_color=COLOURS[_COLOURS[part]],
                hovertemplate="%{y}: %{x:z.2f} µm<extra>" + shown + "</extra>",
            )
            for part, shown in _SHOWN.items()
        ]
    )
    figure.update_layout(
        title="Measured error and its parts",
        xaxis_title="µm RMS",
        barmode="group",
        yaxis={"autorange": "reversed", "dtick": 1},
        height=max(360, 110 + 52 * len(names)),
    )
    return styled(figure)


def _name(condition: Mapping[str, Any]) -> str:
    return f"{condition['plane']} R{condition['radius_mm']:g} F{condition['feed_mm_min']:g} {condition['direction']}"


def _number(value: float | None) -> str:
    return "-" if value is None or not math.isfinite(value) else f"{value:z.2f}"
