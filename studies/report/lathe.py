"""A compensation of the virtual lathe as text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dtwin.kinds.linear._report import before_after_lines


def compensation_text(compared: Mapping[str, Any]) -> str:
    """Return before and after on the virtual lathe."""
    states = {
        "before": compared["before"],
        "after": compared["after"],
        "after, no wander": compared["after_without_wander"],
        "exact map": compared["perfect_correction"],
    }
    acted = ", ".join(f"{name} {count}" for name, count in compared["guard"].items())
    return "\n".join(
        [
            *before_after_lines(states),
            f"{compared['ticks']} cycles on the {compared['clock']}; guard: {acted}; largest change in one "
            f"cycle {compared['largest_step_um']:z.1f} µm",
        ]
    )


def wall_clock_text(timed: Mapping[str, Any]) -> str:
    """Return how the loop kept its time."""
    begun, work = timed["jitter_ms"], timed["work_ms"]
    allowed = ", ".join(f"{name} {said}" for name, said in timed["realtime"].items())
    return "\n".join(
        [
            f"{timed['cycles']} cycles of 10 ms on the wall clock: {timed['corrected']} corrected, "
            f"{timed['missed']} missed, {timed['late']} late, {timed['unaccounted']} not accounted for",
            f"begun after due, ms: p50 {begun['p50']:z.3f}, p99.9 {begun['p99.9']:z.3f}, max "
            f"{begun['max']:z.3f}; work, ms: p50 {work['p50']:z.3f}, p99.9 {work['p99.9']:z.3f}",
            f"the system: {allowed}",
        ]
    )
