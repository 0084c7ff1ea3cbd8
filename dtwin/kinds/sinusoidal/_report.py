"""Text of tests that command tones, and of their compensation."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from dtwin.kinds.sinusoidal._check import commanded, followed, heard
from dtwin.report.text import table
from dtwin.schema import Run

if TYPE_CHECKING:
    pass


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
