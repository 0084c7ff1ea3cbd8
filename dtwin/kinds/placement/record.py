"""Placements of parts by a robot: where each was put, and what a rule flagged."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from dtwin.kinds.kind import Kind

if TYPE_CHECKING:
    from dtwin.schema import Finding, Run


class _Placement(Kind):
    name = "placement"
    columns = ("t_s", "error_x_um", "error_y_um")

    def judge_run(self, run: Run) -> list[Finding]:
        from dtwin.acquire.quality import judge_clock, judge_flagged

        # Placements are events: minutes between them are no lost samples.
        clock = [finding for finding in judge_clock(run) if finding.code != "clock.dropout"]
        return clock + judge_flagged(run)

    def training_obstacle(self, rows: Sequence[Mapping[str, Any]]) -> str:
        return "placements train no equation"


KIND = _Placement()
