"""Text of tests that command tones, and of their compensation."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from dtwin.kinds.sinusoidal._check import commanded, followed, heard
from dtwin.kinds.sinusoidal._plots import Surface, surface_figures_of, trial_figures
from dtwin.report.html import Section, Table
from dtwin.report.text import table
from dtwin.schema import Run


def tone_result(run: Run) -> dict[str, Any]:
    """Return ``tone``: how a run followed its tone, JSON-ready. ``run``: of kind ``sinusoidal``."""
    told, errors, sensed = commanded(run), followed(run), heard(run)
    figures: dict[str, Any] = asdict(told)
    if errors is not None:
        figures |= asdict(errors) | {"amplitude_error_um": errors.amplitude_error_um}
    if sensed is not None:
        figures |= {"heard_share_1": sensed.share}
    return {"tone": figures}


_COLUMNS = (
    ("Hz", "frequency_hz", "g"),
    ("um", "amplitude_um", "g"),
    ("encoder µm", "encoder_um", "z.3f"),
    ("lag deg", "encoder_lag_deg", "z.2f"),
    ("tool µm", "tool_um", "z.3f"),
    ("lag deg", "tool_lag_deg", "z.2f"),
    ("tracking µm", "tracking_um", "z.3f"),
    ("total µm", "total_um", "z.3f"),
    ("amplitude error µm", "amplitude_error_um", "z.3f"),
    ("heard", "heard_share_1", ".0%"),
)


def tone_lines(runs: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return one line for each run with what encoder and tool did, and its findings.

    ``runs``: from ``dtwin.report.checking.run_result``.
    """
    rows = []
    for run in runs:
        tone = run.get("tone", {})
        cells = [
            format(tone[key], form) if math.isfinite(tone.get(key, math.nan)) else "-" for _, key, form in _COLUMNS
        ]
        told = ", ".join(f["code"] for f in run["findings"] if f["severity"] != "info")
        rows.append([run["run"], *cells, told or "-"])
    by_code = {f["code"]: f for run in runs for f in run["findings"]}
    return [
        *table(("run", *(title for title, _, _ in _COLUMNS), "findings"), rows).splitlines(),
        *(f"{f['severity']}: {f['message']}" for f in by_code.values()),
    ]


_FIGURES = (
    ("form µm", "form_um", "z.3f"),
    ("phase deg", "phase_deg", "z.3f"),
    ("vector µm", "vector_um", "z.3f"),
    ("p-v µm", "peak_to_valley_um", "z.3f"),
)


def _trial_table(trial: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Return head and rows of surfaces without and with a correction.

    ``trial``: from ``dtwin.kinds.sinusoidal.trial.trial``.
    """
    head = ["Hz", "rpm", *(f"{title}: without, with" for title, _, _ in _FIGURES), "alarm"]
    rows = []
    for row in trial["rows"]:
        cells = [
            f"{row['before'][key]:{form}}, {row['after'][key]:{form}} ({-100.0 * row['reduction'][key]:+z.1f} %)"
            for _, key, form in _FIGURES
        ]
        rows.append([f"{row['frequency_hz']:g}", f"{row['spindle_rpm']:g}", *cells, row["alarm"] or "-"])
    return head, rows


def trial_text(trial: Mapping[str, Any]) -> str:
    """Return surfaces without and with a correction for a terminal."""
    guard: dict[str, int] = {}
    for row in trial["rows"]:
        for name, count in row["guard"].items():
            guard[name] = guard.get(name, 0) + count
    acted = ", ".join(f"{name} {count}" for name, count in guard.items())
    worse = ", ".join(f"{f:g} Hz" for f in trial["worse"]) or "none"
    return "\n".join(
        [
            f"{trial['surface']}; at the rim; {trial['clock']}, slide {trial['truth']}",
            table(*_trial_table(trial)),
            f"frequencies that became worse: {worse}; guard, ticks: {acted}",
        ]
    )


def trial_section(trial: Mapping[str, Any], surfaces: Mapping[float, tuple[Surface, Surface]]) -> Section:
    """Return the section about surfaces without and with a correction.

    ``trial``: from ``dtwin.kinds.sinusoidal.trial.trial``.
    ``surfaces``: without and with, by frequency; may be empty.
    """
    figures = trial_figures(trial["rows"])
    if surfaces:
        figures += surface_figures_of(max(surfaces), surfaces[max(surfaces)])
    return Section(
        "Surfaces without and with the correction",
        [
            f"Bicuspid surface {trial['surface']}. Form and phase error are those of the rim; vector is "
            f"the length of the difference of both sines. {trial['clock']}; virtual slide: "
            f"{trial['truth']}."
        ],
        [("warning", f"{r['frequency_hz']:g} Hz: {r['alarm']}") for r in trial["rows"] if r["alarm"]],
        [Table(*_trial_table(trial))],
        figures,
    )
