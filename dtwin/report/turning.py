"""Text of tests that command tones, and of their compensation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from dtwin.acquire.sinusoidal_runs import commanded, followed, heard
from dtwin.report.text import table
from dtwin.schema import Run


def tone_result(run: Run) -> dict[str, Any]:
    """Return ``tone``: how a run followed its tone, JSON-ready.

    Parameters
    ----------
    run : Run
        Of kind ``sinusoidal``.
    """
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
    ("encoder um", "encoder_um", ".3f"),
    ("lag deg", "encoder_lag_deg", ".2f"),
    ("tool um", "tool_um", ".3f"),
    ("lag deg", "tool_lag_deg", ".2f"),
    ("tracking um", "tracking_um", ".3f"),
    ("total um", "total_um", ".3f"),
    ("amplitude error um", "amplitude_error_um", ".3f"),
    ("heard", "heard_share_1", ".0%"),
)


def tone_lines(runs: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return one line for each run with what encoder and tool did, and its findings.

    Parameters
    ----------
    runs : sequence of mapping
        From ``dtwin.report.checking.run_result``.
    """
    rows = []
    for run in runs:
        tone = run.get("tone", {})
        cells = [format(tone[key], form) if key in tone else "-" for _, key, form in _COLUMNS]
        told = ", ".join(f["code"] for f in run["findings"] if f["severity"] != "info")
        rows.append([run["run"], *cells, told or "-"])
    told = {f["code"]: f for run in runs for f in run["findings"]}
    return [
        *table(("run", *(title for title, _, _ in _COLUMNS), "findings"), rows).splitlines(),
        *(f"{f['severity']}: {f['message']}" for f in told.values()),
    ]
