"""The source thesis's mill equation as text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dtwin.report.text import table
from dtwin.units import shown_number


def position_map_text(found: Mapping[str, Any]) -> str:
    """Return what decides the equation, and what a map of positions is worth.

    ``found``: what ``position_map`` returned.
    """
    influence = [
        (name, f"{shown_number(low)} to {shown_number(high)}", f"{shown_number(100 * found['influence'][name], 2)} %")
        for name, (low, high) in found["ranges"].items()
    ]
    points = ", ".join(f"{p['error_um']:z.1f} at ({p['x_mm']:g}, {p['y_mm']:g})" for p in found["at"])
    sessions = [
        (
            s["session"],
            s["runs"],
            f"{s['before_um']:z.2f}",
            f"{s['after_um']:z.2f}",
            f"{s['r2']:z.3f}",
            f"{s['mounting_out_before_um']:z.2f}",
            f"{s['mounting_out_after_um']:z.2f}",
        )
        for s in found["sessions"]
    ]
    return "\n".join(
        [
            "equation 6-2 of the thesis, as printed, on a circle of 50 mm: share of its variance "
            "that goes with each input (total Sobol index)",
            table(("input", "range", "share"), influence),
            f"with no following error and no vibration it returns, in µm: {points}",
            "",
            "a map of the path angle, trained as the thesis does: runs 1 to 3 of each feed, run 4 "
            "left out, on the virtual mill (unit: the run; µm RMS)",
            table(("tried on", "runs", "before", "after", "R²", "mounting out, before", "after"), sessions),
            f"verdict: {found['verdict']}",
            "",
            *_robot_lines(found["robot"]),
        ]
    )


def _robot_lines(found: Mapping[str, Any]) -> list[str]:
    quiet, ordinary, critical = zip(*found["at"].values(), strict=True)
    said, measured = (
        f"{v[0]:z.0f} to {v[2]:z.0f}, median {v[1]:z.0f} µm" for v in (found["said_um"], found["measured_um"])
    )
    return [
        "equation 6-1, which corrected the robot, in its three forms: radial error in mm of a quiet "
        "window, an ordinary one, and one at its critical RMS",
        table(
            ("form", "quiet", "ordinary", "critical"),
            [
                (form, *(shown_number(v, 4) for v in values))
                for form, *values in zip(found["at"], quiet, ordinary, critical, strict=True)
            ],
        ),
        f"the program's form on {found['windows']} windows of {found['runs']} circles of the virtual "
        f"cobot (unit: the window of 0.5 s): 21.8 times the mean square along Y alone gives it with R² "
        f"{found['decided_r2']:z.4f}; it says {said}, the ball bar {measured}; R² against the bar "
        f"{shown_number(found['held_against_bar_r2'])}",
        "equation 6-3 (error along Y) is not evaluated: what its F4 is, is not printed",
    ]
