"""Placements of parts by a robot: where each was put, and what a rule flagged."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from dtwin.kinds.kind import Kind

if TYPE_CHECKING:
    from dtwin.schema import Finding, Run


_LEAST_UM, _MOST_UM = 1.0, 1e5
"""Between these lies the largest error of a robot that places parts."""


class _Placement(Kind):
    name = "placement"
    columns = ("t_s", "error_x_um", "error_y_um")

    def judge_run(self, run: Run) -> list[Finding]:
        from dtwin.acquire.quality import judge_clock, judge_flagged

        # Placements are events: minutes between them are no lost samples.
        clock = [finding for finding in judge_clock(run) if finding.code != "clock.dropout"]
        return clock + judge_flagged(run) + _sizes(run)

    def training_obstacle(self, rows: Sequence[Mapping[str, Any]]) -> str:
        return "placements train no equation"


def _sizes(run: Run) -> list[Finding]:
    """Return what errors of another unit look like, and a direction that was not measured."""
    from dtwin.schema import Finding

    errors = {name: run.samples[name] for name in _Placement.columns if name.startswith("error_")}
    largest = max(float(abs(values).max()) for values in errors.values())
    if largest and not _LEAST_UM <= largest <= _MOST_UM:
        text = f"the largest error is {largest:.3g} µm: is it another unit? A robot places within {_LEAST_UM:g} to {_MOST_UM:g} µm"
        return [Finding("placement.units", "error", text, {"largest_um": largest})]
    still = [name for name, values in errors.items() if largest and len(values) > 1 and not values.any()]
    text = f"{' and '.join(still)} is 0 at every placement: this direction was not measured"
    return [Finding("placement.still", "warning", text)] if still else []


KIND = _Placement()
